"""The real job again and again, timed: call `benchmark.run_benchmark`; `compare` tells noise from change."""
