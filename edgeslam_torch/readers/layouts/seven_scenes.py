"""7-Scenes sequences as Microsoft publishes them: ``seq-01/frame-000000.color.png``, ``.depth.png``, ``.pose.txt``."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.geometry.se3 import exp
from edgeslam_torch.readers.images import ASSUMED_HZ
from edgeslam_torch.readers.listing import ImageEntry, Problem, in_order
from edgeslam_torch.readers.sequence import DepthMaps, Sequence

KIND = "7scenes"

COLOUR_CAMERA = replace(
    PRESETS["kinect"], cx=320.0, cy=240.0, source="the 7-Scenes default (Kinect colour camera, 525 px)"
)

DEPTH_CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0, source="7-Scenes depth camera")
"""https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/: (585, 585), (320, 240)."""

T_COLOUR_DEPTH = exp(np.array([-0.028, 0.003, 0.0, 0.0064, 0.0021, 0.0079]))
"""Depth camera to colour camera of the 7-Scenes Kinect, whose published depth maps are not registered to colour.

Fitted to redkitchen: depth discontinuities of 25 maps, transformed by this and projected with the colour camera's 525
px, are nearest to the Canny edges of its colour images (mean capped distance 3.78 px; translation alone 4.18; no
motion 5.6, and a free focal length is estimated at 526). Figures that compare redkitchen's maps with its depth
therefore rest on a fit to its own images. The 2.8 cm are the Kinect's known baseline.
"""

_COLOUR = "frame-*.color.*"


def recognises(folder: Path) -> bool:
    """Whether the folder holds ``frame-NNNNNN.color.png`` files."""
    return next(folder.glob(_COLOUR), None) is not None


def read(folder: Path) -> Sequence:
    """Stamps are the files' numbers at 30 Hz; the data set has no others."""
    images, problems = _numbered(folder, _COLOUR)
    has_poses = next(folder.glob("*.pose.txt"), None) is not None
    has_depth = next(folder.glob("*.depth.png"), None) is not None
    return Sequence(
        KIND,
        folder,
        tuple(images),
        tuple(problems),
        groundtruth=folder if has_poses else None,
        camera=COLOUR_CAMERA,
        depth=(lambda: _depth(folder)) if has_depth else None,
        name="_".join(folder.resolve().parts[-2:]),
    )


def _depth(folder: Path) -> DepthMaps:
    maps, problems = _numbered(folder, "*.depth.png")
    stamps, paths = np.array([entry.stamp_s for entry in maps]), tuple(entry.path for entry in maps)
    return DepthMaps(stamps, paths, 1e-3, DEPTH_CAMERA, T_COLOUR_DEPTH, tuple(problems))


def _numbered(folder: Path, pattern: str) -> tuple[list[ImageEntry], list[Problem]]:
    entries: list[ImageEntry] = []
    problems: list[Problem] = []
    for i, path in enumerate(sorted(folder.glob(pattern))):
        number = path.name.split(".")[0].removeprefix("frame-")
        if re.fullmatch("[0-9]+", number):
            entries.append(ImageEntry(i, int(number) / ASSUMED_HZ, path))
        else:
            problems.append(Problem(str(path), "no frame number in its name"))
    kept, more = in_order(entries, str(folder))
    return kept, problems + more
