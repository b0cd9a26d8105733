"""Inputs of an evaluation: trajectory files, run folders, data sets with ground truth, and association by time."""
