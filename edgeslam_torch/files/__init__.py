"""Files in general: atomic writing, appending whole lines, reading with one-line errors.

What cannot be written raises `OSError`, which names the file.
"""
