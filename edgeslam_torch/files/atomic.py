"""Files that are either the old one or the new one, never half of one."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Let ``write`` fill a file beside ``path`` and put it in its place when it is whole.

    Raises:
        OSError: If the disk refuses; an older file at ``path`` is then still there.
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
    """Put ``text`` into ``path`` as UTF-8, atomically; bytes of a file name that are no UTF-8 become question marks.

    Raises:
        OSError: If the disk refuses.
    """
    write_atomically(path, lambda file: file.write(text.encode("utf-8", errors="replace")))
