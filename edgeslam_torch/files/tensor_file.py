"""Named arrays in one file, in the layout of safetensors: a JSON header, then the numbers as they are.

Nothing is read before the header is checked against the file's size, so that a hostile file costs at most its own
size; nothing in it is executed.
"""

import json
import math
import reprlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.files.atomic import write_atomically

Array = NDArray[Any]
MAX_HEADER_BYTES = 1 << 20
"""Maximum header size; FastDepth's has 24 kB."""
MAX_DIMENSIONS = 4
KINDS: dict[str, np.dtype[Any]] = {
    "F32": np.dtype("<f4"),
    "F64": np.dtype("<f8"),
    "I32": np.dtype("<i4"),
    "I64": np.dtype("<i8"),
    "U8": np.dtype("u1"),
}
"""Types of numbers that `write_tensors` can write, in safetensors' notation."""


class Damaged(ValueError):
    """What is wrong with a file, without its name."""


class OtherFormat(Damaged):
    """No file of this layout."""


@dataclass(frozen=True, slots=True)
class Entry:
    """An array in an open file."""

    file: BinaryIO
    kind: str
    shape: tuple[int, ...]
    start: int
    """Position in the file."""
    size: int
    """Bytes."""

    def read(self) -> bytes:
        """Its numbers in row-major order, little endian."""
        self.file.seek(self.start)
        return self.file.read(self.size)

    def array(self) -> Array:
        """The same as an array of its shape; only for `KINDS`."""
        return np.frombuffer(self.read(), KINDS[self.kind]).reshape(self.shape).copy()


def read_entries(file: BinaryIO, sizes: Mapping[str, int]) -> tuple[dict[str, Any], dict[str, Entry]]:
    """Remarks and arrays of a file, all of whose bytes lie within it.

    Args:
        file: Open at its beginning.
        sizes: Bytes of one number of every type that is allowed.

    Raises:
        Damaged: If the header is no header, or does not fit the file.
    """
    length = int.from_bytes(file.read(8).ljust(8, b"\xff"), "little")
    if length > MAX_HEADER_BYTES:
        raise OtherFormat("not a safetensors file, or damaged")
    try:
        header = json.loads(file.read(length))
    except (ValueError, RecursionError):
        raise Damaged("not a safetensors file, or damaged: its header is not JSON") from None
    if not isinstance(header, dict):
        raise Damaged("damaged: its header is not a table")
    remarks = header.pop("__metadata__", None) or {}
    end = file.seek(0, 2)
    entries = {name: _entry(file, name, fields, 8 + length, end, sizes) for name, fields in header.items()}
    _check_disjoint(entries)
    return remarks if isinstance(remarks, dict) else {}, entries


def write_tensors(path: Path, remarks: Mapping[str, str], arrays: Mapping[str, Array]) -> None:
    """Write arrays of the types of `KINDS`, atomically."""
    names = {dtype: kind for kind, dtype in KINDS.items()}
    header: dict[str, Any] = {"__metadata__": dict(remarks)}
    begin = 0
    for name, array in arrays.items():
        end = begin + array.nbytes
        header[name] = {"dtype": names[array.dtype], "shape": list(array.shape), "data_offsets": [begin, end]}
        begin = end
    text = json.dumps(header).encode()
    text = text.ljust(-(-len(text) // 8) * 8)  # numbers begin at a multiple of eight bytes

    def write(file: BinaryIO) -> None:
        file.write(len(text).to_bytes(8, "little") + text)
        for array in arrays.values():
            file.write(np.ascontiguousarray(array).tobytes())

    write_atomically(path, write)


def _entry(file: BinaryIO, name: str, fields: Any, offset: int, end: int, sizes: Mapping[str, int]) -> Entry:
    try:
        kind, shape, (start, stop) = fields["dtype"], tuple(fields["shape"]), fields["data_offsets"]
    except (TypeError, KeyError, ValueError):
        raise Damaged(f"damaged: its header describes {name[:80]!r} wrongly") from None
    if not isinstance(kind, str) or kind not in sizes:
        raise Damaged(f"{name[:80]} holds {reprlib.repr(kind)} numbers, not one of {', '.join(sizes)}")
    numbers = (*shape, start, stop)
    if not all(type(n) is int and 0 <= n <= end for n in numbers) or len(shape) > MAX_DIMENSIONS:
        raise Damaged(f"damaged: its header describes {name[:80]!r} wrongly")
    if stop - start != math.prod(shape) * sizes[kind] or offset + stop > end:
        raise Damaged(f"truncated or damaged: the bytes of {name[:80]!r} are missing")
    return Entry(file, kind, shape, offset + start, stop - start)


def _check_disjoint(entries: Mapping[str, Entry]) -> None:
    """Reject arrays that share bytes: no writer creates them, and they would need more memory than the file."""
    last = 0
    for name, entry in sorted(entries.items(), key=lambda item: item[1].start):
        if entry.size and entry.start < last:
            raise Damaged(f"damaged: {name[:80]!r} overlaps another tensor")
        last = max(last, entry.start + entry.size)
