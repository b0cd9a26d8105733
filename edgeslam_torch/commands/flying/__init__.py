"""Commands that fly."""
