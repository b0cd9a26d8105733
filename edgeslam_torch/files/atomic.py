"""Atomic file writing: a reader sees the old or the new file, never half of one."""

import io
import os
import re
import secrets
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from edgeslam_torch.files.plain import check_replaceable, open_exclusively

_PARTIAL = ".edgeslam-{:08x}-{}.part"
_PARTIAL_NAME = re.compile(r"\.edgeslam-(?:([0-9a-f]{8})-)?[0-9a-f]{16}\.part")
"""With the process that writes it."""


def partial_beside(path: Path) -> Path:
    """Unforeseeable name for a file that will be ``path`` when it is complete."""
    return path.with_name(_PARTIAL.format(os.getpid(), secrets.token_hex(8)))


def remove_partials(folder: Path) -> None:
    """Remove what killed processes have left in a folder of ours; what this one is writing stays."""
    for path in folder.iterdir():
        found = _PARTIAL_NAME.fullmatch(path.name)
        if found is not None and found[1] != f"{os.getpid():08x}":
            path.unlink(missing_ok=True)


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then move it into place.

    A link at ``path`` is replaced, not followed.

    Raises:
        OSError: With the name ``path``, if writing fails, or it is no plain file; an older file there is kept.
    """
    check_replaceable(path)
    partial = partial_beside(path)
    try:
        with io.BufferedWriter(open_exclusively(partial)) as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
    finally:
        with suppress(OSError):
            partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` as UTF-8, atomically; undecodable bytes of file names become question marks."""
    write_atomically(path, lambda file: file.write(text.encode("utf-8", errors="replace")))
