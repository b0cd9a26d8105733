"""Evaluation of trajectories, depth and maps.

`metrics.run_score.evaluate_run` judges one run, `report.page.write_report` makes its page,
`benchmark.benchmark.run_benchmark` times the real job, and `judge` runs everything there is.
"""

if __name__ == "eval":
    raise ImportError("import edgeslam_torch.eval, not eval")
