"""One file a job: fine-tuning, distilling, the shipped weights."""
