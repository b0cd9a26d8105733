"""What is judged and by what: trajectory files, run folders, data sets with ground truth, and poses matched by time."""
