"""Exploring: where the known space ends, where it was looked around, and what is looked at twice."""
