"""Evaluation of trajectories, depth and maps; report and benchmark."""

if __name__ == "eval":
    raise ImportError("import edgeslam_torch.eval, not eval")
