"""Operations of ONNX networks, against counts by hand."""

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from edgeslam_torch.models.onnx.operations import Operations, count_operations

MACS = 8 * 5 * 6 * 3 * 9
"""Eight 3x3 filters over three channels, 5 x 6 outputs (stride 2 from 10 x 12)."""


def network(quantised, width=12):
    """One convolution; its image and weights are quantised or not."""
    weight = np.ones((8, 3, 3, 3), np.int8 if quantised else np.float32)
    stored = [numpy_helper.from_array(weight, "w")]
    nodes, names = [], ["image", "w"]
    if quantised:
        stored += [numpy_helper.from_array(np.float32(0.1), "scale"), numpy_helper.from_array(np.int8(0), "zero")]
        nodes = [
            helper.make_node("QuantizeLinear", ["image", "scale", "zero"], ["image_q"]),
            helper.make_node("DequantizeLinear", ["image_q", "scale", "zero"], ["image_d"]),
            helper.make_node("DequantizeLinear", ["w", "scale", "zero"], ["w_d"]),
        ]
        names = ["image_d", "w_d"]
    nodes.append(helper.make_node("Conv", names, ["out"], pads=[1, 1, 1, 1], strides=[2, 2]))
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, 10, width])
    out = helper.make_tensor_value_info("out", TensorProto.FLOAT, None)
    return helper.make_model(helper.make_graph(nodes, "one", [image], [out], stored))


def test_operations_are_those_by_hand():
    assert count_operations(network(False)) == Operations(0, MACS, 8 * 27 * 4)
    assert count_operations(network(True)) == Operations(MACS, 0, 8 * 27)


def test_weights_in_constant_nodes_count_alike():
    model = network(False)
    moved = {tensor.name: tensor for tensor in model.graph.initializer}
    del model.graph.initializer[:]
    for name, tensor in moved.items():
        model.graph.node.insert(0, onnx.helper.make_node("Constant", [], [name], value=tensor))
    assert count_operations(model) == count_operations(network(False))


def test_open_size_has_no_number():
    with pytest.raises(ValueError, match="size of out is open"):
        count_operations(network(False, "width"))


@pytest.mark.parametrize("called", ["f25", "f26"])
def test_functions_that_call_each_other_endlessly_have_no_number(called):
    model = network(False)
    opsets = [helper.make_opsetid("", 18), helper.make_opsetid("own", 1)]
    calls = [("Identity",), *((f"f{i}", f"f{i}") for i in range(25)), (called, called)]
    for i, names in enumerate(calls):
        nodes = [
            helper.make_node(name, [f"t{j}"], [f"t{j + 1}"], domain="" if name == "Identity" else "own")
            for j, name in enumerate(names)
        ]
        model.functions.append(helper.make_function("own", f"f{i}", ["t0"], [f"t{len(names)}"], nodes, opsets))
    model.opset_import.append(opsets[1])
    model.graph.node.append(helper.make_node("f26", ["out"], ["end"], domain="own"))
    with pytest.raises(ValueError, match="functions"):
        count_operations(model)
