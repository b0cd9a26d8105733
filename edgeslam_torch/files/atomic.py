"""Atomic file writing: a reader sees the old or the new file, never half of one."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let ``write`` fill a temporary file beside ``path``, then move it into place.

    Raises:
        OSError: If writing fails; an older file at ``path`` is kept.
    """
    partial = path.with_name(f".{path.name}.part")
    try:
        with partial.open("wb") as file:
            write(file)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write ``text`` to ``path`` as UTF-8, atomically; undecodable bytes of file names become question marks.

    Raises:
        OSError: If writing fails.
    """
    write_atomically(path, lambda file: file.write(text.encode("utf-8", errors="replace")))
