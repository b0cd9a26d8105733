"""Mean errors of an int8 network's channels, taken back through the biases of its convolutions.

Rounding of weights moves every channel by a constant, and depthwise layers most (Nagel et al., "Data-Free Quantization
Through Weight Equalization and Bias Correction", ICCV 2019, section 4.2, here with images).
"""

from collections.abc import Sequence

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import NodeProto, TensorProto, helper, numpy_helper

from edgeslam_torch.models.onnx.file import INPUT

MAX_IMAGES = 18
"""More of the calibration images change nothing: each shows every channel thousands of times."""

Array = NDArray[np.float32]


def correct_biases(model: onnx.ModelProto, exact: onnx.ModelProto, images: Sequence[Array]) -> None:
    """Move the bias of each convolution, from first to last, so that its channels have the exact network's means.

    Args:
        model: The quantised network (QDQ pairs), changed in place.
        exact: The same network in float32, with the same names of tensors.
        images: Preprocessed inputs ``(1, 3, H, W)``; `MAX_IMAGES` of them are used.
    """
    chosen = images[:: -(-len(images) // MAX_IMAGES)]
    convolutions = [node for node in model.graph.node if node.op_type == "Conv" and len(node.input) == 3]
    names = [node.output[0] for node in convolutions]
    for node, wanted in zip(convolutions, _channel_means(exact, names, chosen), strict=True):
        (found,) = _channel_means(model, [_as_seen(model, node.output[0])], chosen)
        _add_to_bias(model, node, wanted - found)


def _as_seen(model: onnx.ModelProto, name: str) -> str:
    """Name of a tensor after quantisation, which is also what clips it."""
    for node in model.graph.node:
        if node.op_type in ("QuantizeLinear", "DequantizeLinear") and node.input[0] == name:
            return _as_seen(model, node.output[0])
    return name


def _channel_means(model: onnx.ModelProto, names: list[str], images: Sequence[Array]) -> list[Array]:
    """Mean of every channel of tensors ``(1, C, h, w)`` over images."""
    import onnxruntime

    opened = onnx.ModelProto()
    opened.CopyFrom(model)
    given = {value.name for value in opened.graph.output}
    missing = [helper.make_tensor_value_info(name, TensorProto.FLOAT, None) for name in names if name not in given]
    opened.graph.output.extend(missing)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    session = onnxruntime.InferenceSession(opened.SerializeToString(), options, providers=["CPUExecutionProvider"])
    means = [[plane.mean((0, 2, 3)) for plane in session.run(names, {INPUT: image})] for image in images]
    return [np.mean(of_one, axis=0) for of_one in zip(*means, strict=True)]


def _add_to_bias(model: onnx.ModelProto, node: NodeProto, change: Array) -> None:
    """Add to the bias of a convolution, which is float32 or int32 with a scale."""
    tensors = {tensor.name: tensor for tensor in model.graph.initializer}
    bias = node.input[2]
    made = next((other for other in model.graph.node if bias in other.output), None)
    if made is None:
        value = numpy_helper.to_array(tensors[bias]) + change
        tensors[bias].CopyFrom(numpy_helper.from_array(value.astype(np.float32), bias))
        return
    stored, scale = made.input[:2]
    steps = np.rint(change / numpy_helper.to_array(tensors[scale])).astype(np.int32)
    tensors[stored].CopyFrom(numpy_helper.from_array(numpy_helper.to_array(tensors[stored]) + steps, stored))
