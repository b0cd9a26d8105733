"""Figures: `run_score.evaluate_run` judges a run; `trajectory_error`, `depth_error` and `edge_map_score` one thing."""
