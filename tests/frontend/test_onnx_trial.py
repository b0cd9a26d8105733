"""ONNX files that would take gigabytes or never end are refused in one line, and leave the process alone."""

import resource

import numpy as np
import pytest
from onnx import TensorProto, helper
from small_networks import describe, green_network, node

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.frontend.depth_network import open_depth

WORDS = 'gives = "metres"\ninput_height = 128\ninput_width = 192\n'
SUM = [node("ReduceMax", "huge", "most"), node("Add", "depth most", "out")]


def loop():
    value = helper.make_tensor_value_info
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"])],
        "body",
        [value("i", TensorProto.INT64, []), value("go", TensorProto.BOOL, [])],
        [value("on", TensorProto.BOOL, [])],
    )
    return helper.make_node("Loop", ["times", "yes"], [], body=body)


HOSTILE = {
    "constant": ([node("ConstantOfShape", "shape", "huge"), *SUM], {"shape": np.array([60_000, 60_000], np.int64)}),
    "expand": ([node("Expand", "most shape", "huge"), *SUM], {"shape": np.array([60_000, 60_000], np.int64)}),
    "grows with the square of the pixels": (
        [node("Reshape", "depth down", "c"), node("Reshape", "depth across", "r"), node("MatMul", "c r", "huge"), *SUM],
        {"down": np.array([-1, 1], np.int64), "across": np.array([1, -1], np.int64)},
    ),
    "loop": ([loop(), node("Identity", "depth", "out")], {"times": np.array(1 << 60, np.int64), "yes": np.array(True)}),
}
HOSTILE["expand"][0][0].input[0] = "near"


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_network_is_one_line(tmp_path, name):
    nodes, constants = HOSTILE[name]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(WeightsError, match="net.onnx") as caught:
        open_depth(describe(green_network(tmp_path / "net.onnx", nodes, "out", constants=constants), WORDS))
    assert "\n" not in str(caught.value)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 200 << 10
