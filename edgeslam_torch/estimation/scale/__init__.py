"""Metric scale: the belief of each source, and the decision between them."""
