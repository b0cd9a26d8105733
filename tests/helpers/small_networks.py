"""Depth networks of a few nodes, as other people's files look: depth or its inverse from the green channel."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

NEAR_M, FAR_M = 1.0, 4.0
"""Depth of black and of full green."""


def green_network(
    path,
    nodes=(),
    output="depth",
    size=("h", "w"),
    input="image",
    channels=3,
    constants=None,
    plane=False,
    numbers=TensorProto.FLOAT,
    last=False,
):
    """``depth = 1 + 3 green`` of RGB in [0, 1], and what further nodes make of it.

    Args:
        path: File to write.
        nodes: After ``depth``; they may use ``constants``.
        output: Names of the outputs, separated by spaces.
        size: Height and width of the input: numbers, or names where they are free.
        input: Name of the input.
        channels: Of the input.
        constants: Further constants by name.
        plane: Whether outputs are ``(1, h, w)`` rather than ``(1, 1, h, w)``.
        numbers: Type of the input's; whole ones go to 255.
        last: Whether the input's channels are its last axis.
    """
    gain = (FAR_M - NEAR_M) / (255.0 if numbers == TensorProto.UINT8 else 1.0)
    stored = {"green": [[[[0.0]], [[gain]], [[0.0]]]], "near": [NEAR_M]} | (constants or {})
    made = [
        helper.make_node("Cast", [input], ["float"], to=TensorProto.FLOAT),
        helper.make_node("Transpose", ["float"], ["rgb"], perm=[0, 3, 1, 2] if last else [0, 1, 2, 3]),
        helper.make_node("Conv", ["rgb", "green", "near"], ["depth"]),
        *nodes,
    ]
    outputs = output.split()
    if plane:
        stored["axes"] = np.array([1], np.int64)
        made += [helper.make_node("Squeeze", [name, "axes"], [f"{name}_plane"]) for name in outputs]
        outputs = [f"{name}_plane" for name in outputs]
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        made,
        "green",
        [value(input, numbers, [1, *size, channels] if last else [1, channels, *size])],
        [value(name, TensorProto.FLOAT, None) for name in outputs],
        [
            numpy_helper.from_array(x if isinstance(x, np.ndarray) else np.array(x, np.float32), name)
            for name, x in stored.items()
        ],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9), str(path))
    return path


def node(kind, inputs, output):
    """One node of a graph, ``node("Add", "depth shift", "moved")``."""
    return helper.make_node(kind, inputs.split(), [output])


RELATIVE = {
    "nodes": (
        node("Reciprocal", "depth", "inverse"),
        node("Mul", "inverse scale", "scaled"),
        node("Add", "scaled shift", "relative"),
    ),
    "output": "relative",
    "constants": {"scale": 37.0, "shift": -4.0},
}
"""Arguments of `green_network` for inverse depth up to scale and shift."""


def describe(path, text):
    """The TOML file beside a network."""
    path.with_suffix(".toml").write_text(text)
    return path
