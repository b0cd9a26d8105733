"""FastDepth as ONNX: exported, folded, quantised, and read back with checks."""
