"""Files in general: written whole or not at all, appended to line by line, read or refused in one line."""
