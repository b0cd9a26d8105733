"""FastDepth as ONNX: export, batch-norm folding, quantisation, and validated reading."""
