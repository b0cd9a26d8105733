"""FastDepth as an ONNX graph straight from a weights file, without torch: for the SLAM's depth stage.

`export_onnx` goes through torch's exporter and creates files for other runtimes; it takes seconds and needs torch in
memory. The graph is a chain of convolutions, so it is built here node by node (a test compares the two).
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from edgeslam_torch.models.layout import LOG_SIGMA_RANGE, MAX_DEPTH_M, MIN_DEPTH_M, SKIP_INTO, STRIDES
from edgeslam_torch.models.onnx.file import INPUT, LOG_DEPTH, SIGMA
from edgeslam_torch.models.record import HEADER_KEY, Metadata
from edgeslam_torch.models.weights_file import Array, read_weights

_EPS = 1e-5
OPSET, IR_VERSION = 17, 9
"""Old enough for every onnxruntime since 1.15."""


def build_graph(path: Path) -> tuple[bytes, Metadata]:
    """Serialised ONNX model (dynamic height and width) and the record of a safetensors file.

    Raises:
        WeightsError: If the file is missing, damaged, no FastDepth, or has implausible values.
    """
    weights, metadata = read_weights(path)
    return _Builder(weights, metadata).model().SerializeToString(), metadata


class _Builder:
    """Appends nodes; each method returns the name of its output."""

    def __init__(self, weights: Mapping[str, Array], metadata: Metadata) -> None:
        self.weights, self.metadata = weights, metadata
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def model(self) -> onnx.ModelProto:
        skips = "conv0.0.weight" in self.weights
        encoder, decoder = ("conv", "decode_conv") if skips else ("mobilenet.", "decoder.conv")
        kept: dict[int, str] = {}
        x = INPUT
        for i in range(14):
            x = self.relu6(self.conv(x, f"{encoder}{i}.0", f"{encoder}{i}.1", STRIDES[i]))
            if i > 0:
                x = self.relu6(self.conv(x, f"{encoder}{i}.3", f"{encoder}{i}.4"))
            kept[i] = x
        for i in range(1, 6):
            x = self.decoder_layer(x, f"{decoder}{i}")
            if i < 5:
                x = self.upsample(x)
            if skips and i in SKIP_INTO:
                x = self.node("Add", x, kept[SKIP_INTO[i]])
        self.finish(x, f"{decoder}6.0", f"{decoder}6.1")
        size: list[str | int | None] = ["batch", 3, "height", "width"]
        out: list[str | int | None] = ["batch", 1, "half_height", "half_width"]
        graph = helper.make_graph(
            self.nodes,
            "fastdepth",
            [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, size)],
            [helper.make_tensor_value_info(n, TensorProto.FLOAT, out) for n in (LOG_DEPTH, SIGMA)],
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        helper.set_model_props(model, {HEADER_KEY: json.dumps(asdict(self.metadata))})
        return model

    def decoder_layer(self, x: str, name: str) -> str:
        if f"{name}.1.0.weight" not in self.weights:  # dense 5x5
            return self.node("Relu", self.conv(x, f"{name}.0", f"{name}.1"))
        x = self.node("Relu", self.conv(x, f"{name}.0.0", f"{name}.0.1"))
        return self.node("Relu", self.conv(x, f"{name}.1.0", f"{name}.1.1"))

    def finish(self, features: str, head: str, norm: str) -> None:
        """Log depth and calibrated sigma; both heads are one convolution of two channels."""
        weight, bias = self.folded(head, norm)
        if "uncertainty.weight" in self.weights:
            both = np.concatenate((weight, self.weights["uncertainty.weight"]))
            biases = np.concatenate((bias, self.weights["uncertainty.bias"]))
            last, raw = f"{head}.out", "uncertainty.out"
            split = self.convolve(features, both, biases, 1, 1, 0, 0)
            sizes = numpy_helper.from_array(np.array([1, 1], np.int64), "head_sizes")
            self.constants.append(sizes)
            self.nodes.append(helper.make_node("Split", [split, "head_sizes"], [last, raw], axis=1))
            raw = self.node("Clip", raw, self.scalar(LOG_SIGMA_RANGE[0]), self.scalar(LOG_SIGMA_RANGE[1]))
            sigma = self.node("Mul", self.node("Exp", raw), self.scalar(self.metadata.sigma_scale))
            variance = self.node("Mul", sigma, sigma)
        else:
            last = self.convolve(features, weight, bias, 1, 1, 0, 0)
            variance = self.node("Mul", last, self.scalar(0.0))
        self.node("Sqrt", self.node("Add", variance, self.scalar(self.metadata.sigma_floor**2)), name=SIGMA)
        if self.metadata.output == "log_depth":
            limit = np.log(MAX_DEPTH_M)
            self.node("Clip", last, self.scalar(-limit), self.scalar(limit), name=LOG_DEPTH)
        else:
            clipped = self.node("Clip", last, self.scalar(MIN_DEPTH_M), self.scalar(MAX_DEPTH_M))
            self.node("Log", clipped, name=LOG_DEPTH)

    def folded(self, name: str, norm: str) -> tuple[Array, Array]:
        """Weight and bias of a convolution with its batch norm folded in."""
        gain = self.weights[f"{norm}.weight"] / np.sqrt(self.weights[f"{norm}.running_var"] + _EPS)
        bias = self.weights[f"{norm}.bias"] - self.weights[f"{norm}.running_mean"] * gain
        return self.weights[f"{name}.weight"] * gain[:, None, None, None], bias

    def conv(self, x: str, name: str, norm: str, stride: int = 1) -> str:
        """Convolution and batch norm."""
        weight, bias = self.folded(name, norm)
        taps = weight.shape[2]
        before = after = taps // 2
        if stride == 2 and self.metadata.padding == "tf_same":
            before = 0
        # Only depthwise convolutions have one input channel here; the stem has three.
        group = weight.shape[0] if weight.shape[1] == 1 and taps > 1 else 1
        return self.convolve(x, weight, bias, stride, group, before, after)

    def convolve(self, x: str, weight: Array, bias: Array, stride: int, group: int, before: int, after: int) -> str:
        taps = weight.shape[2]
        return self.node(
            "Conv",
            x,
            self.constant(weight),
            self.constant(bias),
            kernel_shape=[taps, taps],
            strides=[stride, stride],
            pads=[before, before, after, after],
            group=group,
        )

    def relu6(self, x: str) -> str:
        return self.node("Clip", x, self.scalar(0.0), self.scalar(6.0))

    def upsample(self, x: str) -> str:
        scales = self.constant(np.array([1, 1, 2, 2], np.float32))
        return self.node(
            "Resize",
            x,
            "",
            scales,
            mode="nearest",
            coordinate_transformation_mode="asymmetric",
            nearest_mode="floor",
        )

    def node(self, op: str, *inputs: str, name: str | None = None, **attributes: Any) -> str:
        output = name or f"t{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, list(inputs), [output], **attributes))
        return output

    def scalar(self, value: float) -> str:
        return self.constant(np.float32(value))

    def constant(self, value: Array | np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype=np.float32), name))
        return name
