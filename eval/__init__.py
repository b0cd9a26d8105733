"""Evaluation of trajectories, depth and maps.

`metrics.run_score.evaluate_run` scores one run, `report.page.write_report` writes its page,
`benchmark.benchmark.run_benchmark` measures accuracy and speed, and `judge` runs all recordings and simulations.
"""

if __name__ == "eval":
    raise ImportError("import edgeslam_torch.eval, not eval")
