"""Files in general: atomic writing, appending whole lines, reading with one-line errors."""
