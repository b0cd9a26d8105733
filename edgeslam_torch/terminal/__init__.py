"""What commands show: text without control characters, and the progress of long work on the last line."""
