"""Experiments: cases run in processes of their own (`runner`), figures with their noise (`figures`), `conditions`."""
