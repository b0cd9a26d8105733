"""FastDepth as an ONNX graph straight from a weights file, without torch: what the SLAM runs.

`export_onnx` goes through torch's exporter and makes files for other people's runtimes; it takes seconds
and needs
torch in memory. The SLAM's depth stage wants neither, and the graph is a chain of convolutions, so it is
written here
node by node (a test holds the two together).
"""

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import safetensors.numpy
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.record import Metadata, read_header

Array = NDArray[np.float32]
INPUT, LOG_DEPTH, SIGMA = "image", "log_depth", "sigma_log"
_STRIDES = (2, 1, 2, 1, 2, 1, 2, 1, 1, 1, 1, 1, 2, 1)
_SKIP_INTO = {4: 1, 3: 3, 2: 5}
_EPS = 1e-5
OPSET, IR_VERSION = 17, 9
"""Old enough for every onnxruntime since 1.15."""


def build_graph(path: Path) -> tuple[bytes, Metadata]:
    """Serialised ONNX model (dynamic height and width) and the record of a safetensors file.

    Raises:
        WeightsError: If the file is missing, damaged or no FastDepth.
    """
    metadata = read_header(path)
    try:
        weights = {k: v.astype(np.float32) for k, v in safetensors.numpy.load_file(path).items()}
        model = _Builder(weights, metadata).model()
    except KeyError as missing:
        raise WeightsError(f"{path}: not a FastDepth checkpoint: no parameter {missing}") from None
    return model.SerializeToString(), metadata


class _Builder:
    """Appends nodes; each method returns the name of what it computes."""

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
            x = self.relu6(self.conv(x, f"{encoder}{i}.0", f"{encoder}{i}.1", _STRIDES[i]))
            if i > 0:
                x = self.relu6(self.conv(x, f"{encoder}{i}.3", f"{encoder}{i}.4"))
            kept[i] = x
        for i in range(1, 6):
            x = self.decoder_layer(x, f"{decoder}{i}")
            x = self.upsample(x)
            if skips and i in _SKIP_INTO:
                x = self.node("Add", x, kept[_SKIP_INTO[i]])
        last = self.conv(x, f"{decoder}6.0", f"{decoder}6.1")
        self.finish(last, x)
        size: list[str | int | None] = ["batch", 3, "height", "width"]
        out: list[str | int | None] = ["batch", 1, "height", "width"]
        graph = helper.make_graph(
            self.nodes,
            "fastdepth",
            [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, size)],
            [helper.make_tensor_value_info(n, TensorProto.FLOAT, out) for n in (LOG_DEPTH, SIGMA)],
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        helper.set_model_props(model, {"edgeslam": json.dumps(asdict(self.metadata))})
        return model

    def decoder_layer(self, x: str, name: str) -> str:
        if f"{name}.1.0.weight" not in self.weights:  # dense 5x5
            return self.node("Relu", self.conv(x, f"{name}.0", f"{name}.1"))
        x = self.node("Relu", self.conv(x, f"{name}.0.0", f"{name}.0.1"))
        return self.node("Relu", self.conv(x, f"{name}.1.0", f"{name}.1.1"))

    def finish(self, last: str, features: str) -> None:
        """Log depth from the last layer and calibrated sigma from the uncertainty head."""
        limit = np.float32(np.log(100.0))
        if self.metadata.output == "log_depth":
            self.node("Clip", last, self.constant(-limit), self.constant(limit), name=LOG_DEPTH)
        else:
            clipped = self.node("Clip", last, self.constant(np.float32(1e-3)), self.constant(np.float32(100.0)))
            self.node("Log", clipped, name=LOG_DEPTH)
        floor = self.constant(np.float32(self.metadata.sigma_floor**2))
        if "uncertainty.weight" in self.weights:
            raw = self.conv(features, "uncertainty", None)
            raw = self.node("Clip", raw, self.constant(np.float32(-4.0)), self.constant(np.float32(1.5)))
            sigma = self.node("Mul", self.node("Exp", raw), self.constant(np.float32(self.metadata.sigma_scale)))
            variance = self.node("Mul", sigma, sigma)
        else:
            variance = self.node("Mul", LOG_DEPTH, self.constant(np.float32(0.0)))
        self.node("Sqrt", self.node("Add", variance, floor), name=SIGMA)

    def conv(self, x: str, name: str, norm: str | None, stride: int = 1) -> str:
        """Convolution with its batch norm folded in."""
        weight = self.weights[f"{name}.weight"]
        if norm is None:
            bias = self.weights[f"{name}.bias"]
        else:
            gain = self.weights[f"{norm}.weight"] / np.sqrt(self.weights[f"{norm}.running_var"] + _EPS)
            bias = self.weights[f"{norm}.bias"] - self.weights[f"{norm}.running_mean"] * gain
            weight = weight * gain[:, None, None, None]
        taps = weight.shape[2]
        before = after = taps // 2
        if stride == 2 and self.metadata.padding == "tf_same":
            before = 0
        # Only depthwise convolutions have one input channel here; the stem has three.
        group = weight.shape[0] if weight.shape[1] == 1 and taps > 1 else 1
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
        return self.node("Clip", x, self.constant(np.float32(0.0)), self.constant(np.float32(6.0)))

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

    def constant(self, value: Array | np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype=np.float32), name))
        return name
