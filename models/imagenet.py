"""ImageNet MobileNetV1 from a quantised TFLite file: the encoder FastDepth training starts from.

The file holds uint8 weights with batch norm already folded in: ``w = (q - zero_point) * scale`` per
tensor, biases
int32. We put the folded bias into the batch norm (weight 1, mean 0, variance 1), so names and shapes stay
upstream's.
Field numbers below are those of TFLite's ``schema.fbs``.
"""

import re
import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.extras import needs_extra
from edgeslam_torch.models.fastdepth import FastDepth
from edgeslam_torch.models.layout import Padding

with needs_extra("train", "reading a TFLite file"):
    from flatbuffers import encode, number_types
    from flatbuffers.table import Table

_DTYPES = {2: "<i4", 3: "u1"}
"""TFLite tensor types used here: INT32 (biases) and UINT8 (weights)."""
_LAYER = re.compile(r"MobilenetV1/Conv2d_(\d+)(?:_(depthwise|pointwise))?/")


def load_imagenet_encoder(network: FastDepth, path: Path) -> None:
    """Overwrite the encoder of ``network`` with the TFLite file's weights.

    The network must use TF padding and inputs ``x / 127.5 - 1`` (RGB 0..255) to match the weights' training.

    Raises:
        WeightsError: If the file is no MobileNetV1 1.0 or the network's encoder has other widths.
    """
    if network.padding is not Padding.TF_SAME:
        raise ValueError(f"the ImageNet encoder needs padding {Padding.TF_SAME.value}, not {network.padding.value}")
    folded = read_tflite_encoder(path)
    with torch.no_grad():
        for i, layer in enumerate(network.encoder()):
            for kind, conv in (("", 0),) if i == 0 else (("depthwise", 0), ("pointwise", 3)):
                try:
                    weight, bias = folded[(i, kind)]
                except KeyError:
                    raise WeightsError(f"{path}: holds no layer Conv2d_{i} {kind}; not a MobileNetV1") from None
                target, norm = layer[conv], layer[conv + 1]  # type: ignore[index]
                if target.weight.shape != weight.shape:
                    found, wanted = tuple(weight.shape), tuple(target.weight.shape)
                    raise WeightsError(f"{path}: Conv2d_{i} {kind} is {found}, the network's {wanted}")
                target.weight.copy_(weight)
                norm.reset_running_stats()
                norm.running_var.fill_(1.0 - norm.eps)
                norm.weight.fill_(1.0)
                norm.bias.copy_(bias)


def read_tflite_encoder(path: Path) -> dict[tuple[int, str], tuple[Tensor, Tensor]]:
    """Dequantised ``{(layer, kind): (weight OIHW, bias)}``; kind is ``""``, ``depthwise`` or ``pointwise``.

    Raises:
        WeightsError: If the file is missing or no TFLite flatbuffer.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise WeightsError(f"{path}: cannot read the encoder weights ({error.strerror})") from error
    if data[4:8] != b"TFL3":
        raise WeightsError(f"{path}: not a TFLite file")
    try:
        return _encoder(data)
    except (struct.error, ValueError, TypeError, LookupError, OverflowError) as error:  # invalid offsets
        raise WeightsError(f"{path}: damaged TFLite file ({str(error)[:80]})") from None


def _encoder(data: bytes) -> dict[tuple[int, str], tuple[Tensor, Tensor]]:
    model = _Node(data, encode.Get(number_types.UOffsetTFlags.packer_type, data, 0))
    buffers = [b.array(0, "u1") for b in model.nodes(4)]
    found: dict[tuple[int, str], dict[str, np.ndarray]] = {}
    for tensor in model.nodes(2)[0].nodes(0):
        array = buffers[tensor.scalar(2, "<u4")]
        match = _LAYER.search(tensor.text(3))
        if match is None or array.size == 0:
            continue
        key = (int(match[1]), match[2] or "")
        quantisation = tensor.node(4)
        scale, zero = quantisation.array(2, "<f4")[0], quantisation.array(3, "<i8")[0]
        q = array.view(_DTYPES[tensor.scalar(1, "u1")]).reshape(tensor.array(0, "<i4"))
        kind = "bias" if q.ndim == 1 else "weight"
        found.setdefault(key, {})[kind] = ((q.astype(np.float64) - zero) * scale).astype(np.float32)
    return {k: (_to_oihw(v["weight"], k[1]), torch.from_numpy(v["bias"])) for k, v in found.items()}


def _to_oihw(weight: np.ndarray, kind: str) -> Tensor:
    """TFLite stores ``(O, H, W, I)``, depthwise ``(1, H, W, C)``."""
    axes = (3, 0, 1, 2) if kind == "depthwise" else (0, 3, 1, 2)
    return torch.from_numpy(np.ascontiguousarray(weight.transpose(axes)))


class _Node:
    """A flatbuffer table addressed by field number."""

    def __init__(self, data: bytes, position: int) -> None:
        self._data, self._table = data, Table(data, position)

    def _offset(self, field: int) -> int:
        return self._table.Offset(4 + 2 * field)

    def scalar(self, field: int, dtype: str) -> int:
        o = self._offset(field)
        return int(np.frombuffer(self._data, dtype, 1, o + self._table.Pos)[0]) if o else 0

    def text(self, field: int) -> str:
        return self._table.String(self._offset(field) + self._table.Pos).decode()

    def node(self, field: int) -> "_Node":
        return _Node(self._data, self._table.Indirect(self._offset(field) + self._table.Pos))

    def nodes(self, field: int) -> list["_Node"]:
        o = self._offset(field)
        start, count = self._table.Vector(o), self._table.VectorLen(o)
        return [_Node(self._data, self._table.Indirect(start + 4 * k)) for k in range(count)]

    def array(self, field: int, dtype: str) -> np.ndarray:
        o = self._offset(field)
        if not o:
            return np.empty(0, dtype)
        return np.frombuffer(self._data, dtype, self._table.VectorLen(o), self._table.Vector(o))
