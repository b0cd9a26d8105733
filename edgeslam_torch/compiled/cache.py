"""Machine code kept between runs: beside the source file, or in the user's cache where that cannot be written."""

import hashlib
import importlib.util
import logging
import pickle
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import llvmlite
import numpy as np

from edgeslam_torch.compiled.machine_code import MachineCode, numba_folder, processor
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.files.user_cache import cache_folder

logger = logging.getLogger(__name__)

_DIGEST = 32


def load(source: Path) -> dict[str, MachineCode] | None:
    """Machine code of a source file's functions, None if there is none of this source for this computer."""
    for file in _places(source):
        try:
            content = file.read_bytes()
        except OSError:
            continue
        if content[:_DIGEST] == _digest(content[_DIGEST:]):
            codes: dict[str, MachineCode] = pickle.loads(content[_DIGEST:])
            return codes
        logger.warning("%s is damaged", file)
    return None


def save(source: Path, codes: dict[str, MachineCode]) -> None:
    """Keep the machine code for later runs; other processes see all of it or nothing."""
    content = pickle.dumps(codes)
    for place in _places(source):
        try:
            place.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(place, lambda file: file.write(_digest(content) + content))
            return
        except OSError:
            continue
    logger.warning("no writable cache: every run compiles again")


def _places(source: Path) -> Iterator[Path]:
    """Where the machine code of a source file may be, in order."""
    ours = (Path(__file__).with_name(name) for name in ("build.py", "machine_code.py"))
    made_of = [source, *ours, numba_folder() / "_version.py"]
    made_by = (np.__version__, llvmlite.__version__, sys.version, processor())
    key = _digest(b"".join(file.read_bytes() for file in made_of) + repr(made_by).encode())
    name = f"{source.stem}-{key.hex()[:32]}.loops"
    yield Path(importlib.util.cache_from_source(source)).with_name(name)
    with suppress(RuntimeError):  # a user without a home
        yield cache_folder() / name


def _digest(content: bytes) -> bytes:
    return hashlib.blake2b(content, digest_size=_DIGEST).digest()
