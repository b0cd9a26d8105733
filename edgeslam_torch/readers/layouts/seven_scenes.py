"""7-Scenes sequences as Microsoft publishes them: ``seq-01/frame-000000.color.png`` and ``.pose.txt``."""

import re
from pathlib import Path

from edgeslam_torch.readers.images import ASSUMED_HZ
from edgeslam_torch.readers.listing import ImageEntry, Problem, in_order

PATTERN = "frame-*.color.*"


def is_seven_scenes(folder: Path) -> bool:
    """Whether the folder holds ``frame-NNNNNN.color.png`` files."""
    return next(folder.glob(PATTERN), None) is not None


def list_seven_scenes(folder: Path) -> tuple[list[ImageEntry], list[Problem]]:
    """Images with stamps from their numbers at 30 Hz; the files carry no others."""
    entries: list[ImageEntry] = []
    problems: list[Problem] = []
    for i, path in enumerate(sorted(folder.glob(PATTERN))):
        number = path.name.split(".")[0].removeprefix("frame-")
        if re.fullmatch("[0-9]+", number):
            entries.append(ImageEntry(i, int(number) / ASSUMED_HZ, path))
        else:
            problems.append(Problem(str(path), "no frame number in its name"))
    kept, more = in_order(entries, str(folder))
    return kept, problems + more
