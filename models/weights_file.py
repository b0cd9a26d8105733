"""Weights of a safetensors file as checked float32 arrays; importing this needs no torch.

Nothing is read before the header is checked against the file's size and the network's shapes, so that a hostile file
costs at most its own size.
"""

import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.files.tensor_file import Damaged, Entry, OtherFormat, read_entries
from edgeslam_torch.models.layout import STEP_COUNTER, HasShape, Variant, check_shapes
from edgeslam_torch.models.record import HEADER_KEY, OTHER_NETWORK, Metadata, metadata_from_json, upstream_metadata

logger = logging.getLogger(__name__)

Array = NDArray[Any]
MAX_FILE_BYTES = 1 << 29
"""Maximum file size. The largest official network has 20.7 M parameters, 83 MB; twice that with optimiser state."""
MAX_VALUE = 1e6
"""Maximum absolute value of a parameter; float16, our storage type, ends at 65504."""
FLOATS: dict[str, np.dtype[Any]] = {
    "F16": np.dtype("<f2"),
    "F32": np.dtype("<f4"),
    "F64": np.dtype("<f8"),
    "BF16": np.dtype("<u2"),
}
"""Storage types of parameters and how to read them; bfloat16 as its bits."""
_SIZES = {kind: dtype.itemsize for kind, dtype in FLOATS.items()} | {"I64": 8}


class Stored(Protocol):
    """A tensor that is not yet read."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Size of every dimension."""

    @property
    def kind(self) -> str:
        """Type of its numbers, in safetensors' notation."""

    def read(self) -> bytes:
        """Its numbers in row-major order, little endian."""


def plain_name(name: str) -> str:
    """A parameter's name without what DataParallel, `torch.compile` and Lightning put before it."""
    while (rest := name.removeprefix("module.").removeprefix("_orig_mod.").removeprefix("model.")) != name:
        name = rest
    return name


def read_weights(path: Path) -> tuple[dict[str, Array], Metadata]:
    """Parameters of a safetensors file in float32 and its metadata.

    A file without metadata is fed as upstream's, with a warning.

    Raises:
        WeightsError: If the file is missing, damaged, of another network, or has implausible values.
    """
    with opened(path) as file:
        metadata, entries = _read_header(file)
        if metadata is None:
            metadata = metadata_without_record(entries, path)
        return check_weights(entries, metadata), metadata


def metadata_without_record(state: Mapping[str, HasShape], path: Path) -> Metadata:
    """How to feed FastDepth weights that say nothing of themselves, as its authors do; their origin is not known.

    Raises:
        WeightsError: If they are of another network.
    """
    if any(name.startswith("uncertainty.") for name in state):
        raise WeightsError(
            "weights of a network of ours without its record, which says how to feed it; write them by "
            "`save_checkpoint(network, metadata, path)`"
        )
    metadata = replace(upstream_metadata(state), data=(), licence="", notes="no record; fed as the authors' weights")
    logger.warning(
        f"{path}: has no record: taken for FastDepth that gives metres for RGB in [0, 1] at "
        f"{metadata.input_width}x{metadata.input_height}, f {metadata.focal_px:.0f} px; origin and licence unknown"
    )
    return metadata


def read_header(path: Path) -> Metadata:
    """The record in a safetensors file's header, without reading the weights.

    Raises:
        WeightsError: If the file is missing, no safetensors file, or has no usable metadata.
    """
    with opened(path) as file:
        metadata, _ = _read_header(file)
        if metadata is None:
            raise WeightsError("not an EdgeSLAM weights file: it holds no record")
    return metadata


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """A weights file for reading; errors within the block say its name.

    Raises:
        WeightsError: If it cannot be read, and as the block.
    """
    try:
        with open_weights(path) as file:
            yield file
    except OSError as error:
        raise WeightsError(f"{path}: cannot read the weights ({error.strerror or error})") from error
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from None


def open_weights(path: Path) -> BinaryIO:
    """Open a weights file for reading.

    Raises:
        WeightsError: If the file is missing or too large; without the file's name.
        OSError: If it cannot be opened.
    """
    if not path.exists():
        raise WeightsError("no such weights file; `edgeslam weights list` shows what there is")
    if not path.is_file():
        raise WeightsError("not a file")
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise WeightsError(f"{size / 2**20:.0f} MiB, more than any network of ours ({MAX_FILE_BYTES >> 20} MiB)")
    return path.open("rb")


def check_weights(state: Mapping[str, Stored], metadata: Metadata) -> dict[str, Array]:
    """Read and validate a state dict: names, shapes, types and values.

    Args:
        state: Tensors by name; those of the right shape are read one by one.
        metadata: Metadata of the file.

    Returns:
        Parameters by name, float32; batch norm's step counters, if any, as int64.

    Raises:
        WeightsError: With the reason, without the file's name.
    """
    if metadata.variant == OTHER_NETWORK:
        raise WeightsError("is not FastDepth by its record; other networks come as ONNX files")
    check_shapes(state, Variant(metadata.variant), metadata.uncertainty)
    return {k: _counter(k, v) if k.endswith(STEP_COUNTER) else _as_float32(k, v) for k, v in state.items()}


def _counter(name: str, stored: Stored) -> Array:
    if stored.kind != "I64":
        raise WeightsError(f"{name} holds {stored.kind} numbers, not I64")
    return np.frombuffer(stored.read(), "<i8").astype(np.int64).reshape(())


def _as_float32(name: str, stored: Stored) -> Array:
    """A parameter in single precision."""
    dtype = FLOATS.get(stored.kind)
    if dtype is None:
        raise WeightsError(f"{name} holds {stored.kind} numbers, not one of {', '.join(FLOATS)}")
    raw = np.frombuffer(stored.read(), dtype)
    if stored.kind == "BF16":  # the upper half of a float32
        raw = (raw.astype("<u4") << 16).view("<f4")
    largest = float(np.abs(raw).max(initial=0.0))
    if not math.isfinite(largest):
        raise WeightsError(f"{name} holds values that are not finite")
    if largest > MAX_VALUE:
        raise WeightsError(f"{name} reaches {largest:.1e}; no trained network goes beyond {MAX_VALUE:.0e}")
    if name.endswith("running_var") and (raw < 0).any():
        raise WeightsError(f"{name} holds a negative variance")
    return raw.astype(np.float32).reshape(stored.shape)


def _read_header(file: BinaryIO) -> tuple[Metadata | None, dict[str, Entry]]:
    """Metadata, if any, and tensors, whose bytes all lie within the file."""
    try:
        remarks, entries = read_entries(file, _SIZES)
    except OtherFormat as error:
        raise WeightsError(f"{error} (`edgeslam weights convert` reads torch's .pth and .pt)") from None
    except Damaged as error:
        raise WeightsError(str(error)) from None
    record = remarks.get(HEADER_KEY)
    if not isinstance(record, str | None):
        raise WeightsError("its metadata cannot be used: it is not text")
    entries = {plain_name(name): entry for name, entry in entries.items()}
    return None if record is None else metadata_from_json(record), entries
