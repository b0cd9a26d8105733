"""Biases of a quantised network move until its channels have the exact network's means."""

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from edgeslam_torch.models.onnx.bias_correction import correct_biases

SCALE = 1e-3
"""Of the biases stored as int32."""


@pytest.fixture
def images(rng):
    return [rng.normal(size=(1, 3, 8, 8)).astype(np.float32) for _ in range(20)]


def two_layers(shift, stored_as_int):
    """Two convolutions with biases off by ``shift``; the second sees the first's mistakes."""
    rng = np.random.default_rng(0)
    tensors, nodes = [], []
    for layer, (channels, source) in enumerate(((4, "image"), (2, "first"))):
        weight = rng.normal(size=(channels, 3 if layer == 0 else 4, 1, 1)).astype(np.float32)
        bias = rng.normal(size=channels).astype(np.float32) + np.float32(shift)
        tensors.append(numpy_helper.from_array(weight, f"w{layer}"))
        if stored_as_int:
            tensors.append(numpy_helper.from_array(np.rint(bias / SCALE).astype(np.int32), f"b{layer}_stored"))
            tensors.append(numpy_helper.from_array(np.full(channels, SCALE, np.float32), f"b{layer}_scale"))
            ends = [f"b{layer}_stored", f"b{layer}_scale"]
            nodes.append(helper.make_node("DequantizeLinear", ends, [f"b{layer}"], axis=0))
        else:
            tensors.append(numpy_helper.from_array(bias, f"b{layer}"))
        nodes.append(helper.make_node("Conv", [source, f"w{layer}", f"b{layer}"], ["first" if layer == 0 else "last"]))
    value = helper.make_tensor_value_info
    ends = value("image", TensorProto.FLOAT, [1, 3, 8, 8]), value("last", TensorProto.FLOAT, [1, 2, 8, 8])
    graph = helper.make_graph(nodes, "two", ends[:1], ends[1:], tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def last(model, image):
    return onnxruntime.InferenceSession(model.SerializeToString()).run(["last"], {"image": image})[0]


@pytest.mark.parametrize("stored_as_int", [False, True])
def test_shifted_biases_are_taken_back_layer_by_layer(images, stored_as_int):
    exact, wrong = two_layers(0.0, False), two_layers(0.3, stored_as_int)
    assert np.abs(last(wrong, images[0]) - last(exact, images[0])).max() > 0.2
    correct_biases(wrong, exact, images)
    onnx.checker.check_model(wrong, full_check=True)
    np.testing.assert_allclose(last(wrong, images[0]), last(exact, images[0]), atol=0.01 if stored_as_int else 1e-5)
