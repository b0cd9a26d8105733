"""Depth for images without labels: measured by the poses of a run, and said by a larger network."""
