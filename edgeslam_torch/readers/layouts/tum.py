"""Folders in the layout of the TUM RGB-D benchmark: ``rgb.txt`` lists stamps and image files."""

import math
import re
from dataclasses import replace
from pathlib import Path

from edgeslam_torch.errors import SourceError
from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.readers.images import entries_from_names, image_files
from edgeslam_torch.readers.listing import ImageEntry, Problem, in_order, seconds_from

LISTS = ("rgb.txt", "images.txt")


def is_tum(folder: Path) -> bool:
    """Whether the folder has an image list, or an ``rgb/`` folder with images."""
    return find_list(folder) is not None or ((folder / "rgb").is_dir() and bool(image_files(folder / "rgb")))


def find_list(folder: Path) -> Path | None:
    """``rgb.txt`` or ``images.txt``; None when the folder has neither."""
    return next((folder / name for name in LISTS if (folder / name).is_file()), None)


def default_camera(name: str) -> Camera | None:
    """The benchmark's calibration when the folder's name tells its camera (``freiburg1_xyz``, ``tum_fr2_desk``)."""
    match = re.search(r"(?:freiburg|fr)([123])(?!\d)", name.lower())
    if match is None:
        return None
    return replace(PRESETS[f"tum_fr{match[1]}"], source=f"the benchmark's calibration of freiburg{match[1]}")


def list_tum(folder: Path) -> tuple[list[ImageEntry], list[Problem]]:
    """Images of the folder in time order, and what had to be left out.

    Raises:
        SourceError: If the list holds no image.
    """
    listing = find_list(folder)
    if listing is None:
        return in_order(entries_from_names(image_files(folder / "rgb")), str(folder / "rgb"))
    rows, problems = read_list(listing)
    if not rows:
        raise SourceError(f"{listing}: lists no image; a line is 'stamp path', such as '12.34 rgb/12.34.png'")
    stamps, _ = seconds_from([stamp for stamp, _ in rows])
    entries = [ImageEntry(i, float(stamps[i]), folder / name) for i, (_, name) in enumerate(rows)]
    kept, more = in_order(entries, str(listing))
    return kept, problems + more


def read_list(path: Path) -> tuple[list[tuple[float, str]], list[Problem]]:
    """Rows ``stamp path`` of a list; lines that are not such a row become problems.

    Raises:
        SourceError: If the file is not text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (UnicodeDecodeError, OSError) as error:
        raise SourceError(f"{path}: cannot be read as a text list of images ({error})") from error
    rows: list[tuple[float, str]] = []
    problems: list[Problem] = []
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if not line or line.startswith("#"):
            continue
        stamp, _, name = line.replace(",", " ", 1).partition(" ")
        value = _finite(stamp)
        if value is None or not name.strip():
            problems.append(Problem(f"{path}:{number}", f"not 'stamp path': {line[:60]!r}"))
            continue
        rows.append((value, name.strip()))
    return rows, problems


def _finite(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
