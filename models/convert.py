"""Upstream's checkpoints, which are pickles of whole modules, turned into plain tensors without running them.

A pickle is a program: ``GLOBAL`` and ``REDUCE`` call whatever it names. The unpickler here resolves names
from a short
list only: tensor rebuilding, containers, and empty stand-ins for ``torch.nn`` modules and upstream's own
classes.
Everything else ends the conversion before anything is called.
"""

import io
import pickle
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import build_network, save_checkpoint, upstream_metadata
from edgeslam_torch.models.fastdepth import FastDepth, Widths
from edgeslam_torch.models.record import Metadata

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_LEGACY_PROTOCOL = 1001
_STORAGES = {
    "FloatStorage": torch.float32,
    "DoubleStorage": torch.float64,
    "HalfStorage": torch.float16,
    "LongStorage": torch.int64,
    "IntStorage": torch.int32,
    "ByteStorage": torch.uint8,
}
_UPSTREAM_CLASSES = {"MobileNet", "MobileNetSkipAdd", "MobileNetSkipConcat", "NNConv", "Identity"}
_UPSTREAM_MODULES = {"models", "imagenet.mobilenet", "__main__"}
MAX_TENSOR_BYTES = 1 << 30
_DAMAGE = (
    pickle.UnpicklingError,
    zipfile.BadZipFile,
    EOFError,
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    RuntimeError,
    OverflowError,
    MemoryError,
)
"""What reading arbitrary bytes as a pickle, zip or tensor raises."""


class _Module:
    """Stands in for any module class of a pickle: keeps what `nn.Module` keeps, can do nothing."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({k: state[k] for k in ("_parameters", "_buffers", "_modules") if k in state})


class _Storage:
    """A typed block of bytes, filled in after the pickle was read."""

    def __init__(self, dtype: torch.dtype, count: int, data: bytes | None) -> None:
        self.dtype, self.count = dtype, int(count)
        size = torch.empty(0, dtype=dtype).element_size()
        if not 0 <= self.count * size <= MAX_TENSOR_BYTES:
            raise WeightsError(f"checkpoint claims a tensor storage of {self.count} elements")
        self.values = torch.zeros(self.count, dtype=dtype)
        if data is not None:
            self.fill(data)

    def fill(self, data: bytes) -> None:
        read = torch.frombuffer(bytearray(data), dtype=self.dtype) if data else torch.empty(0, dtype=self.dtype)
        if read.numel() != self.count:
            raise WeightsError("checkpoint is truncated: a tensor's bytes are missing")
        self.values.copy_(read)


def _rebuild_tensor(storage: _Storage, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: Any) -> Tensor:
    if not isinstance(storage, _Storage):
        raise WeightsError("checkpoint rebuilds a tensor from something that is no storage")
    return torch.as_strided(storage.values, tuple(size), tuple(stride), int(offset))


def _rebuild_parameter(data: Tensor, *_: Any) -> Tensor:
    return data


def _make_ordered(*args: Any) -> OrderedDict[Any, Any]:
    return OrderedDict(*args)


class RestrictedUnpickler(pickle.Unpickler):
    """Resolves only tensors, containers and inert stand-ins for modules."""

    def __init__(self, file: io.BufferedIOBase | io.BytesIO, records: dict[str, bytes] | None = None) -> None:
        super().__init__(file, encoding="utf-8")
        self._records = records
        self.storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        """The only door from a pickle to code."""
        if module == "collections" and name == "OrderedDict":
            return _make_ordered
        if module in ("builtins", "__builtin__") and name == "set":
            return set
        if module == "torch._utils" and name in ("_rebuild_tensor", "_rebuild_tensor_v2"):
            return _rebuild_tensor
        if module == "torch._utils" and name == "_rebuild_parameter":
            return _rebuild_parameter
        if module == "torch" and name in _STORAGES:
            return _STORAGES[name]
        if module == "torch" and name == "Size":
            return tuple
        if module.startswith("torch.nn.modules.") and isinstance(getattr(nn, name, None), type):
            return _Module
        if module in _UPSTREAM_MODULES and name in _UPSTREAM_CLASSES:
            return _Module
        if module in ("numpy.core.multiarray", "numpy._core.multiarray") and name == "scalar":
            return _ignored
        if (module, name) in (("numpy", "dtype"), ("metrics", "Result")):
            return _Ignored
        raise WeightsError(f"checkpoint refers to {module}.{name}: refused, it may run code; nothing was run")

    def persistent_load(self, pid: Any) -> Any:
        """A storage named by the pickle: ``("storage", dtype, key, location, count, view)``.

        Legacy files also wrap classes as ``("module", class, file, source)``; the class came through
        `find_class`.
        """
        if isinstance(pid, tuple) and len(pid) == 4 and pid[0] == "module" and pid[1] is _Module:
            return pid[1]
        if not (isinstance(pid, tuple) and len(pid) >= 5 and pid[0] == "storage" and isinstance(pid[1], torch.dtype)):
            raise WeightsError("checkpoint holds an unknown kind of external object: refused")
        key, count = str(pid[2]), pid[4]
        if key not in self.storages:
            if self._records is not None and key not in self._records:
                raise WeightsError("checkpoint is truncated: a tensor's bytes are missing")
            self.storages[key] = _Storage(pid[1], count, None if self._records is None else self._records[key])
        return self.storages[key]


def _ignored(*_: Any) -> None:
    """numpy scalars beside the model (epoch, best result) carry nothing we need."""


class _Ignored:
    """Stands in for numpy dtypes and upstream's ``best_result``."""

    def __init__(self, *_: Any) -> None:
        """Take anything, keep nothing."""

    def __setstate__(self, state: Any) -> None:
        """Nothing to restore."""


def read_upstream(path: Path) -> dict[str, Tensor]:
    """State dict of an official checkpoint (``checkpoint['model']``, a bare module, or a state dict).

    Raises:
        WeightsError: If the file is damaged, refers to anything but tensors and modules, or holds no network.
    """
    try:
        content = _read_zip(path) if zipfile.is_zipfile(path) else _read_legacy(path)
    except OSError as error:
        raise WeightsError(f"{path}: cannot read ({error.strerror})") from error
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from None
    except _DAMAGE as error:
        raise WeightsError(f"{path}: damaged checkpoint ({type(error).__name__}: {str(error)[:120]})") from None
    if isinstance(content, dict):
        content = content.get("model", content.get("state_dict", content))
    state: dict[str, Tensor] = {}
    if isinstance(content, _Module):
        _collect(content, "", state, 0)
    elif isinstance(content, dict):
        state = {str(k): v for k, v in content.items() if isinstance(v, Tensor)}
    return {k.removeprefix("module."): v.clone() for k, v in state.items()}


def convert_upstream(path: Path, out: Path) -> Metadata:
    """Write an official checkpoint as safetensors with metadata.

    Raises:
        WeightsError: If it is no FastDepth checkpoint.
    """
    state = read_upstream(path)
    metadata = upstream_metadata(state)
    network = build_network(metadata, Widths.of_state_dict(state))
    load_into(network, state, path)
    save_checkpoint(network, metadata, out)
    return metadata


def load_into(network: FastDepth, state: dict[str, Tensor], path: Path) -> None:
    """Strict `load_state_dict`, tolerating checkpoints older than batch norm's step counter."""
    own = network.state_dict()
    filled = {k: v for k, v in own.items() if k.endswith("num_batches_tracked")} | state
    try:
        network.load_state_dict(filled)
    except RuntimeError as error:
        raise WeightsError(
            f"{path}: does not fit {network.variant.value}: {' '.join(str(error).split())[:200]}"
        ) from None


def _collect(module: _Module, prefix: str, state: dict[str, Tensor], depth: int) -> None:
    if depth > 20:
        raise WeightsError("modules are nested too deeply")
    for group in ("_parameters", "_buffers"):
        for name, value in getattr(module, group, {}).items():
            if isinstance(value, Tensor):
                state[prefix + name] = value
    for name, child in getattr(module, "_modules", {}).items():
        if isinstance(child, _Module):
            _collect(child, f"{prefix}{name}.", state, depth + 1)


def _read_zip(path: Path) -> Any:
    """torch >= 1.6: ``<archive>/data.pkl`` beside ``<archive>/data/<key>``."""
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
        root = next((n.removesuffix("data.pkl") for n in names if n.endswith("/data.pkl")), None)
        if root is None:
            raise WeightsError("no data.pkl inside: not a torch file")
        if sum(i.file_size for i in archive.infolist()) > MAX_TENSOR_BYTES:
            raise WeightsError("unpacks to more than 1 GiB: refused")
        prefix = f"{root}data/"
        records = {n.removeprefix(prefix): archive.read(n) for n in names if n.startswith(prefix)}
        return RestrictedUnpickler(io.BytesIO(archive.read(f"{root}data.pkl")), records).load()


def _read_legacy(path: Path) -> Any:
    """torch < 1.6: magic, protocol, system info, object, storage keys, then the storages' bytes."""
    with path.open("rb") as file:
        if RestrictedUnpickler(file).load() != _LEGACY_MAGIC:
            raise WeightsError("not a torch checkpoint")
        if RestrictedUnpickler(file).load() != _LEGACY_PROTOCOL:
            raise WeightsError("unknown torch file protocol")
        RestrictedUnpickler(file).load()
        reader = RestrictedUnpickler(file)
        content = reader.load()
        for key in RestrictedUnpickler(file).load():
            storage = reader.storages[str(key)]
            count = int.from_bytes(file.read(8), "little")
            if count != storage.count:
                raise WeightsError("checkpoint is damaged: a tensor's length differs")
            storage.fill(file.read(count * storage.values.element_size()))
        return content
