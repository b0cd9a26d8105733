"""Depth training: data, recipe and hooks."""

if __name__ == "train":
    raise ImportError("import edgeslam_torch.train, not train")
