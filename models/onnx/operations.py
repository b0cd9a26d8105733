"""Multiply-accumulates of an ONNX network, by the numbers that they are made of."""

from dataclasses import dataclass
from math import prod

import onnx
from onnx import numpy_helper

_QUANTISED = ("DequantizeLinear",)


@dataclass(frozen=True, slots=True)
class Operations:
    """Of one image; biases, activations and resizing are not counted."""

    int8_macs: int
    """Of convolutions whose image and weights are both quantised."""
    float_macs: int
    weight_bytes: int
    """Of all convolutions, as stored."""


def count_operations(model: onnx.ModelProto) -> Operations:
    """Count the convolutions of a network of fixed size.

    Raises:
        ValueError: If there is no number: a size is open, or there are functions, which may call each other so often
            that they never end.
    """
    if model.functions:
        raise ValueError("what its functions compute is not counted: export them inlined to count")
    graph = onnx.shape_inference.infer_shapes(model).graph
    shapes = {value.name: _shape(value) for value in (*graph.value_info, *graph.output)}
    stored = {tensor.name: tensor for tensor in graph.initializer}
    stored |= {
        node.output[0]: attribute.t
        for node in graph.node
        if node.op_type == "Constant" and node.output
        for attribute in node.attribute
        if attribute.name == "value"
    }
    makers = {name: node for node in graph.node for name in node.output}
    counts, weight_bytes = {True: 0, False: 0}, 0
    for node in graph.node:
        if node.op_type != "Conv":
            continue
        sources = [makers.get(name) for name in node.input[:2]]
        quantised = all(source is not None and source.op_type in _QUANTISED for source in sources)
        name, steps = (node.input[1] if len(node.input) > 1 else ""), len(graph.node)
        while name not in stored:
            maker, steps = makers.get(name), steps - 1
            if maker is None or not maker.input or steps < 0:
                raise ValueError(f"the weights of {node.output[0]} are computed, not stored")
            name = maker.input[0]
        weight = numpy_helper.to_array(stored[name])
        size = shapes.get(node.output[0])
        if size is None:
            raise ValueError(f"the size of {node.output[0]} is open: export with a fixed size to count")
        counts[quantised] += prod(size) * prod(weight.shape[1:])
        weight_bytes += weight.nbytes
    return Operations(counts[True], counts[False], weight_bytes)


def _shape(value: onnx.ValueInfoProto) -> tuple[int, ...] | None:
    """Sizes with a batch of one image; None while one is open."""
    sizes = [d.dim_value if d.HasField("dim_value") else None for d in value.type.tensor_type.shape.dim]
    return None if not sizes or any(size is None for size in sizes[1:]) else (1, *(int(s or 0) for s in sizes[1:]))
