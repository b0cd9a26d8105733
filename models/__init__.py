"""Networks: FastDepth in torch, its checkpoints, ONNX export and quantisation."""

if __name__ == "models":
    raise ImportError("import edgeslam_torch.models, not models")
