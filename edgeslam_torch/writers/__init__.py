"""What a run leaves behind: its folder (`run_writer`), maps in other formats, recorded flights, pictures.

What cannot be written raises `OSError`, which names the file.
"""
