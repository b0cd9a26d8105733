"""One module per data set: detects its folder and locates images, stamps, camera, ground truth and depth.

A module in this folder is a layout. It has ``KIND``, ``recognises(folder)`` and ``read(folder)`` as in `Layout`; no
other file refers to it. The first module, by name, that recognises a folder reads it.
"""

import importlib
import pkgutil
from functools import lru_cache
from pathlib import Path
from typing import Protocol, cast

from edgeslam_torch.readers.sequence import Sequence


class Layout(Protocol):
    """Interface of a layout module."""

    KIND: str
    """Short name, as in ``summary.json``."""

    @staticmethod
    def recognises(folder: Path) -> bool:
        """Whether a folder has this layout; looks at file names only."""

    @staticmethod
    def read(folder: Path) -> Sequence:
        """The recording in a recognised folder.

        Raises:
            SourceError: If the list of images is missing or malformed.
        """


@lru_cache(maxsize=1)
def layouts() -> tuple[Layout, ...]:
    """All layouts, by name."""
    names = sorted(module.name for module in pkgutil.iter_modules(__path__))
    return tuple(cast(Layout, importlib.import_module(f"{__name__}.{name}")) for name in names)


def layout_of(folder: Path) -> Layout | None:
    """The layout that recognises a folder."""
    return next((layout for layout in layouts() if layout.recognises(folder)), None)


def read_sequence(folder: Path) -> Sequence | None:
    """The recording in a folder; None when no layout recognises it.

    Raises:
        SourceError: If the list of images is missing or malformed.
    """
    layout = layout_of(folder)
    return None if layout is None else layout.read(folder)
