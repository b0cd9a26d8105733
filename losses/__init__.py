"""Losses shared by Levenberg-Marquardt refinement and depth training."""

if __name__ == "losses":
    raise ImportError("import edgeslam_torch.losses, not losses")
