"""Torch's checkpoint files, zip or legacy: tensors located by name without executing the file."""

import math
import struct
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.inert_pickle import Call, External, InertPickle, Instance, Name
from edgeslam_torch.models.weights_file import opened, plain_name

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001
_KINDS = {
    "FloatStorage": ("F32", 4),
    "DoubleStorage": ("F64", 8),
    "HalfStorage": ("F16", 2),
    "BFloat16Storage": ("BF16", 2),
    "LongStorage": ("I64", 8),
    "IntStorage": ("I32", 4),
    "ShortStorage": ("I16", 2),
    "CharStorage": ("I8", 1),
    "ByteStorage": ("U8", 1),
    "BoolStorage": ("BOOL", 1),
}
"""Storage class: safetensors' name of its type, and bytes per number."""
MAX_PARTS = 5000
"""Maximum modules and tensors of a network; FastDepth has 130 and 300, and a module may occur under several names."""
MAX_DIRECTORY_BYTES = 1 << 20
"""Maximum size of a zip's directory; FastDepth's has 20 kB."""
STATES = ("model", "state_dict", "model_state_dict")
"""Where training scripts keep the network in a checkpoint."""


@dataclass(frozen=True, slots=True)
class TorchTensor:
    """A tensor that is not yet read; it lies within its storage and is not larger."""

    shape: tuple[int, ...]
    kind: str
    """Type of its numbers, in safetensors' notation."""
    stride: tuple[int, ...]
    offset: int
    item_bytes: int
    storage: Callable[[], bytes]

    def read(self) -> bytes:
        """Its numbers in row-major order, little endian."""
        items = np.frombuffer(self.storage(), f"<u{self.item_bytes}")[self.offset :]
        steps = tuple(s * self.item_bytes for s in self.stride)
        return np.lib.stride_tricks.as_strided(items, self.shape, steps, writeable=False).tobytes()


class Checkpoint(NamedTuple):
    """Contents of a torch file."""

    state: Mapping[str, TorchTensor]
    """Tensors by name, by `plain_name`."""
    record: Any
    """Value of ``metadata`` beside them, or None."""
    is_module: bool
    """Whether it was a whole pickled network, not a state dict."""


@contextmanager
def open_checkpoint(path: Path) -> Iterator[Checkpoint]:
    """The tensors of ``checkpoint['model']``, ``'state_dict'`` or ``'model_state_dict'``, a bare module or state dict.

    Raises:
        WeightsError: If the file is missing or damaged, or holds no network; also from inside the ``with``, with the
            file's name.
    """
    with opened(path) as file:
        if file.seek(0, 2) == 0:
            raise WeightsError("empty file")
        if is_zip(file):
            with _open_zip(file) as archive:
                yield _checkpoint(_ZipReader(archive))
        else:
            with mmap(file.fileno(), 0, access=ACCESS_READ) as data:
                yield _checkpoint(_LegacyReader(data))


def is_zip(file: BinaryIO) -> bool:
    """Whether a file starts like torch's zip files."""
    file.seek(0)
    return file.read(4) == b"PK\x03\x04"


class _Storage(NamedTuple):
    """A typed block of bytes that a pickle names."""

    key: str
    kind: str
    item_bytes: int
    items: int


class _ZipReader:
    """torch >= 1.6: ``<archive>/data.pkl`` beside ``<archive>/data/<key>``."""

    def __init__(self, archive: zipfile.ZipFile) -> None:
        self._archive = archive
        name = next((n for n in archive.namelist() if n.endswith("/data.pkl")), None)
        if name is None:
            raise WeightsError("no data.pkl inside: not a torch file")
        self._folder = name.removesuffix("data.pkl")
        self.content = InertPickle(self._read(name)).load()

    def bytes_of(self, storage: _Storage) -> bytes:
        """All bytes of a storage."""
        name = f"{self._folder}data/{storage.key}"
        if name not in self._archive.NameToInfo:
            raise WeightsError("truncated checkpoint: a tensor's bytes are missing")
        if self._archive.NameToInfo[name].file_size < storage.items * storage.item_bytes:
            raise WeightsError("damaged checkpoint: a tensor is larger than its bytes")
        return self._read(name)

    def _read(self, name: str) -> bytes:
        try:
            return self._archive.read(name)
        except (zipfile.BadZipFile, struct.error, EOFError, RuntimeError, ValueError) as error:
            raise WeightsError(f"damaged zip file ({str(error)[:80]})") from None


class _LegacyReader:
    """torch < 1.6: magic, protocol, system info, object, storage keys, then the storages' bytes."""

    def __init__(self, data: mmap) -> None:
        self._data = data
        reader = InertPickle(data)
        if reader.load() != _LEGACY_MAGIC:
            raise WeightsError("not a torch checkpoint")
        if reader.load() != _LEGACY_PROTOCOL:
            raise WeightsError("unknown torch file protocol")
        reader.load()
        self.content = reader.load()
        self._places: dict[str, tuple[int, int]] = {}
        self._locate(reader)

    def bytes_of(self, storage: _Storage) -> bytes:
        """All bytes of a storage."""
        start, count = self._places.get(storage.key, (0, -1))
        if count != storage.items:
            raise WeightsError("damaged checkpoint: a tensor's length differs")
        return self._data[start : start + count * storage.item_bytes]

    def _locate(self, reader: InertPickle) -> None:
        """Offset and length of each storage."""
        storages = {s.key: s for s in map(_as_storage, reader.externals) if s is not None}
        keys = reader.load()
        position = reader.position
        for key in keys if isinstance(keys, list) else ():
            storage = storages.get(key) if isinstance(key, str) else None
            if storage is None:
                raise WeightsError("damaged checkpoint: bytes of an unknown tensor")
            count = int.from_bytes(self._data[position : position + 8], "little")
            position += 8 + count * storage.item_bytes
            if position > len(self._data):
                raise WeightsError("truncated checkpoint: a tensor's bytes are missing")
            self._places[key] = (position - count * storage.item_bytes, count)


def _open_zip(file: BinaryIO) -> zipfile.ZipFile:
    """Open an archive as written by torch: uncompressed, entries not larger than the file."""
    size = file.seek(0, 2)
    reads = _Reads(file)
    try:
        archive = zipfile.ZipFile(reads)
    except (zipfile.BadZipFile, struct.error, EOFError, RuntimeError, ValueError, LookupError) as error:
        raise WeightsError(f"damaged zip file ({str(error)[:80]})") from None
    reads.limit = size
    entries = archive.infolist()
    if any(e.compress_type != zipfile.ZIP_STORED or e.file_size != e.compress_size for e in entries):
        raise WeightsError("damaged checkpoint: torch compresses nothing, this zip file does")
    if sum(e.file_size for e in entries) > size:
        raise WeightsError("damaged checkpoint: the parts of this zip file are larger than the whole")
    return archive


class _Reads:
    """A file that limits the length of reads: `zipfile` reads a directory of any length at once."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable
        self.limit = MAX_DIRECTORY_BYTES

    def read(self, count: int = -1) -> bytes:
        """As of any file object.

        Raises:
            WeightsError: If there is more than the limit.
        """
        data = self._file.read(self.limit + 1 if count < 0 else min(count, self.limit + 1))
        if len(data) > self.limit:
            raise WeightsError("damaged checkpoint: this zip file lists too many parts")
        return data


def _checkpoint(reader: _ZipReader | _LegacyReader) -> Checkpoint:
    content, record = reader.content, None
    if isinstance(content, dict):
        record = content.get("metadata")
        content = next((content[key] for key in STATES if key in content), content)
    tensors: dict[str, TorchTensor] = {}
    if isinstance(content, Instance):
        _collect(content, reader.bytes_of, tensors)
    elif isinstance(content, dict):
        if len(content) > MAX_PARTS:
            raise WeightsError(f"holds {len(content)} tensors, more than any FastDepth")
        found = {str(name): _as_tensor(value, reader.bytes_of) for name, value in content.items()}
        tensors = {name: tensor for name, tensor in found.items() if tensor is not None}
    if not tensors:
        there = f": it holds {', '.join(map(str, content))[:80]}" if isinstance(content, dict) else ""
        raise WeightsError(f"holds no network, itself or as {', '.join(STATES)}{there}")
    state = {plain_name(name): tensor for name, tensor in tensors.items()}
    return Checkpoint(state, record, isinstance(content, Instance))


def _collect(root: Instance, bytes_of: Callable[[_Storage], bytes], tensors: dict[str, TorchTensor]) -> None:
    """Tensors of a module and all modules below it, named as `state_dict` names them."""
    waiting = [("", root)]
    parts = 0
    while waiting:
        prefix, module = waiting.pop()
        state = module.state if isinstance(module.state, dict) else {}
        for group in ("_parameters", "_buffers", "_modules"):
            members = state.get(group)
            for name, value in members.items() if isinstance(members, dict) else ():
                parts += 1
                if parts > MAX_PARTS:
                    raise WeightsError(f"holds more than {MAX_PARTS} modules and tensors, more than any FastDepth")
                if group == "_modules" and isinstance(value, Instance):
                    waiting.append((f"{prefix}{str(name)[:80]}.", value))
                elif (tensor := _as_tensor(value, bytes_of)) is not None:
                    tensors[f"{prefix}{str(name)[:80]}"] = tensor


def _as_tensor(value: Any, bytes_of: Callable[[_Storage], bytes]) -> TorchTensor | None:
    """The tensor that a call would have rebuilt, or None."""
    if isinstance(value, Call) and value.name.name == "_rebuild_parameter" and value.arguments:
        value = value.arguments[0]
    if not isinstance(value, Call) or not value.name.name.startswith("_rebuild_tensor"):
        return None
    storage = _as_storage(value.arguments[0]) if len(value.arguments) >= 4 else None
    if storage is None:
        raise WeightsError("damaged checkpoint: a tensor without bytes")
    offset, shape, stride = value.arguments[1], _integers(value.arguments[2]), _integers(value.arguments[3])
    if not _is_count(offset) or shape is None or stride is None or len(shape) != len(stride):
        raise WeightsError("damaged checkpoint: a tensor without a shape")
    items = math.prod(shape)
    last = offset + sum((n - 1) * step for n, step in zip(shape, stride, strict=True)) if items else 0
    if items > storage.items or last >= max(storage.items, 1):
        raise WeightsError(f"damaged checkpoint: a tensor of shape {shape} in a storage of {storage.items} numbers")
    return TorchTensor(shape, storage.kind, stride, offset, storage.item_bytes, lambda: bytes_of(storage))


def _as_storage(value: Any) -> _Storage | None:
    """Decode ``("storage", class, key, location, count, view)``; None for anything else."""
    fields = value.id if isinstance(value, External) else None
    if not isinstance(fields, tuple) or len(fields) < 5 or fields[0] != "storage" or not isinstance(fields[1], Name):
        return None
    key, count, is_view = fields[2], fields[4], any(part is not None for part in fields[5:])
    if not isinstance(key, str) or not _is_count(count) or fields[1].name not in _KINDS or is_view:
        return None
    return _Storage(key, *_KINDS[fields[1].name], count)


def _integers(value: Any) -> tuple[int, ...] | None:
    """A shape or stride of a tensor of up to 8 dimensions."""
    if isinstance(value, Call) and value.name == Name("torch", "Size") and len(value.arguments) == 1:
        value = value.arguments[0]
    plain = isinstance(value, tuple) and len(value) <= 8 and all(_is_count(n) for n in value)
    return value if plain else None


def _is_count(value: Any) -> bool:
    return type(value) is int and 0 <= value < 1 << 40
