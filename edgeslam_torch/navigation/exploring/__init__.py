"""Exploring: where the known space ends, and where it was looked around."""
