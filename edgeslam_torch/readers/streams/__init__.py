"""Coded pictures of streams."""
