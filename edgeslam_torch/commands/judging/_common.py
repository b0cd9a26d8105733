"""What the commands that run experiments share."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from edgeslam_torch.errors import OutputError


def recordings(given: Path | None) -> Path | None:
    """Folder of recordings: the given one, else ``EDGESLAM_DATA``, if any."""
    return given or (Path(os.environ["EDGESLAM_DATA"]) if os.environ.get("EDGESLAM_DATA") else None)


def say(text: str) -> None:
    """One line of progress."""
    sys.stderr.write(text + "\n")


@contextmanager
def writing() -> Iterator[None]:
    """Turn an operating system's error into one line.

    Raises:
        OutputError: If a file cannot be written.
    """
    try:
        yield
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be written ({error.strerror or error})") from error
