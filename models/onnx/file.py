"""Exported ONNX files, checked before they run; importing this needs no torch."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnx
from google.protobuf.message import DecodeError
from onnx import TensorProto, numpy_helper

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.layout import INPUT_MULTIPLE
from edgeslam_torch.models.record import HEADER_KEY, MAX_INPUT_PX, Metadata, metadata_from_json
from edgeslam_torch.models.weights_file import MAX_FILE_BYTES, open_weights, opened

INPUT, LOG_DEPTH, SIGMA = "image", "log_depth", "sigma_log"
MAX_VALUE = 1e9
"""Maximum constant of an exported network: batch norm multiplies weights of up to 1e6."""
LOOPS = ("Loop", "Scan", "SequenceMap")
_FLOATS = (TensorProto.FLOAT, TensorProto.FLOAT16, TensorProto.DOUBLE)


@dataclass(frozen=True, slots=True)
class OnnxFile:
    """An ONNX file, read and parsed once: those of others have hundreds of megabytes."""

    path: Path
    content: bytes
    model: onnx.ModelProto

    @property
    def is_ours(self) -> bool:
        """Whether it holds a record of this project."""
        return any(p.key == HEADER_KEY for p in self.model.metadata_props)


def parse_onnx(path: Path) -> OnnxFile:
    """Read a file, with the numbers that lie in files beside it; nothing in it is checked yet, but that it ends.

    Raises:
        WeightsError: If it is missing or no ONNX file, needs files that are not beside it, or holds a loop.
    """
    with opened(path) as file:
        try:
            content = file.read()
            model = onnx.load_model_from_string(content)
            for graph in every_graph(model):
                loops = [node.op_type for node in graph if node.op_type in LOOPS]
                if loops:
                    raise WeightsError(
                        f"holds a {loops[0]}: its termination is undecidable; export the network without"
                    )
            if _brought_in(model, path):
                content = model.SerializeToString()
        except (DecodeError, ValueError, TypeError, RuntimeError, onnx.checker.ValidationError) as error:
            raise WeightsError(f"damaged or not an ONNX file ({' '.join(str(error).split())[:80]})") from None
    return OnnxFile(path, content, model)


def every_graph(model: onnx.ModelProto) -> Iterator[Sequence[onnx.NodeProto]]:
    """Nodes of the graph, of its functions, and of the graphs within nodes."""
    waiting = [model.graph.node, *(function.node for function in model.functions)]
    while waiting:
        nodes = waiting.pop()
        yield nodes
        for node in nodes:
            for attribute in node.attribute:
                waiting += [graph.node for graph in (attribute.g, *attribute.graphs) if graph.node]


def _brought_in(model: onnx.ModelProto, path: Path) -> bool:
    """Read the numbers that lie in other files of the same folder into the model; whether there were any."""
    outside = [t for t in _constants(model.graph) if t.data_location == TensorProto.EXTERNAL]
    total = path.stat().st_size
    places = []
    for tensor in outside:
        entry = {part.key: part.value for part in tensor.external_data}
        name = entry.get("location", "")
        if Path(name).name != name:
            raise WeightsError(f"its numbers lie in {name!r}, outside the file's folder; save the network as one file")
        if not (path.parent / name).is_file():
            raise WeightsError(f"its numbers are to lie in {name!r} beside it, and no such file is there; copy it too")
        with open_weights(path.parent / name) as opened:
            whole = opened.seek(0, os.SEEK_END)
        offset = int(entry.get("offset", 0))
        length = int(entry.get("length", whole - offset))
        if not (offset >= 0 and 0 <= length <= whole - offset):
            raise WeightsError(f"{tensor.name} is to lie in {name!r} where that file has ended; copy it again")
        total += length
        places.append((name, offset, length))
    if total > MAX_FILE_BYTES:
        raise WeightsError(f"{total >> 20} MiB with its data, more than any network that is read here")
    for tensor, (name, offset, length) in zip(outside, places, strict=True):
        with open_weights(path.parent / name) as opened:  # also a link, as caches of downloads make them
            opened.seek(offset)
            tensor.raw_data = opened.read(length)
        tensor.data_location = TensorProto.DEFAULT
        del tensor.external_data[:]
    return bool(outside)


def read_onnx(file: OnnxFile | Path) -> tuple[bytes, Metadata]:
    """A file written by ``edgeslam export`` and its record.

    Raises:
        WeightsError: If the file is missing, damaged, not from this project, or has implausible values.
    """
    file = file if isinstance(file, OnnxFile) else parse_onnx(file)
    try:
        metadata = _record(file.model)
        _check_ends(file.model.graph)
        for tensor in _constants(file.model.graph):
            _check_constant(tensor)
    except (ValueError, TypeError) as error:
        raise WeightsError(f"{file.path}: damaged or not an ONNX file ({' '.join(str(error).split())[:80]})") from None
    except WeightsError as error:
        raise WeightsError(f"{file.path}: {error}") from None
    return file.content, metadata


def _record(model: onnx.ModelProto) -> Metadata:
    record = next((p.value for p in model.metadata_props if p.key == HEADER_KEY), None)
    if record is None:
        raise WeightsError("holds no EdgeSLAM metadata, or is not an ONNX file; export it with `edgeslam export`")
    return metadata_from_json(record)


def _check_ends(graph: onnx.GraphProto) -> None:
    """Reject a graph without image input and outputs for log depth and sigma."""
    constants = {tensor.name for tensor in graph.initializer}
    inputs = [value for value in graph.input if value.name not in constants]
    outputs = {value.name for value in graph.output}
    if [value.name for value in inputs] != [INPUT] or not outputs >= {LOG_DEPTH, SIGMA}:
        raise WeightsError(f"not a depth network of ours: it should make {LOG_DEPTH} and {SIGMA} of {INPUT}")
    shape = inputs[0].type.tensor_type.shape.dim
    sides = [d.dim_value for d in shape[2:]]  # 0 for a dynamic size
    good = all(0 <= side <= MAX_INPUT_PX and side % INPUT_MULTIPLE == 0 for side in sides)
    if len(shape) != 4 or shape[1].dim_value != 3 or not good:
        size = [d.dim_value or d.dim_param for d in shape]
        raise WeightsError(f"its input is {size}, expected [1, 3, H, W] in multiples of {INPUT_MULTIPLE}")


def _constants(graph: onnx.GraphProto) -> Iterator[TensorProto]:
    yield from graph.initializer
    for node in graph.node:
        yield from (attribute.t for attribute in node.attribute if attribute.HasField("t"))


def _check_constant(tensor: TensorProto) -> None:
    """Reject external, non-finite or implausible constants."""
    if tensor.data_location == TensorProto.EXTERNAL:
        raise WeightsError(f"{tensor.name} lies outside the file; export it into one")
    if tensor.data_type not in _FLOATS:
        return
    largest = float(np.abs(numpy_helper.to_array(tensor).astype(np.float64)).max(initial=0.0))
    if not np.isfinite(largest):
        raise WeightsError(f"{tensor.name} holds values that are not finite")
    if largest > MAX_VALUE:
        raise WeightsError(f"{tensor.name} reaches {largest:.1e}; no trained network goes beyond {MAX_VALUE:.0e}")
