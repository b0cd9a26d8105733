"""Repeated timed runs: `benchmark.run_benchmark`; `compare` separates change from noise."""
