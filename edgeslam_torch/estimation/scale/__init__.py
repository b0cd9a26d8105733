"""Metric scale: estimates of each source, their uncertainty, and consensus between them."""
