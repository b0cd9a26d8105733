"""Folders in the layout of the TUM RGB-D benchmark: ``rgb.txt`` lists stamps and images, ``depth.txt`` depth maps."""

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from edgeslam_torch.errors import CalibrationError, SourceError
from edgeslam_torch.files.tables import read_table
from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.geometry.camera_file import camera_keys
from edgeslam_torch.readers.images import image_files, list_image_folder
from edgeslam_torch.readers.layouts import seven_scenes
from edgeslam_torch.readers.listing import ImageEntry, Problem, entries_in_time, nothing_listed, read_list
from edgeslam_torch.readers.sequence import DepthMaps, Sequence

KIND = "tum"
LISTS = ("rgb.txt", "images.txt")
DEPTH_LIST = "depth.txt"
_DEPTH_SCALE_KEYS = ("depth_scale", "DepthMapFactor", "RGBD.DepthMapFactor")
_TUM_UNITS_PER_METRE = 5000.0
"""https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats"""


def recognises(folder: Path) -> bool:
    """Whether the folder has an image list, or an ``rgb/`` folder with images."""
    return find_list(folder) is not None or ((folder / "rgb").is_dir() and bool(image_files(folder / "rgb")))


def find_list(folder: Path) -> Path | None:
    """``rgb.txt`` or ``images.txt``; None when the folder has neither."""
    return next((folder / name for name in LISTS if (folder / name).is_file()), None)


def default_camera(name: str) -> Camera | None:
    """The benchmark's calibration if the folder's name identifies its camera (``freiburg1_xyz``,
    ``tum_fr2_desk``)."""
    match = re.search(r"(?:freiburg|fr)([123])(?!\d)", name.lower())
    if match is None:
        return None
    return replace(PRESETS[f"tum_fr{match[1]}"], source=f"the benchmark's calibration of freiburg{match[1]}")


def read(folder: Path) -> Sequence:
    """Images by ``rgb.txt`` or ``images.txt``, else by the names in ``rgb/``.

    Raises:
        SourceError: If the list holds no image.
    """
    images, problems = _images(folder)
    truth = folder / "groundtruth.txt"
    return Sequence(
        KIND,
        folder,
        tuple(images),
        tuple(problems),
        groundtruth=truth if truth.is_file() else None,
        camera=default_camera(folder.resolve().name),
        depth=(lambda: _depth(folder)) if (folder / DEPTH_LIST).is_file() else None,
    )


def _images(folder: Path) -> tuple[list[ImageEntry], list[Problem]]:
    listing = find_list(folder)
    if listing is None:
        return list_image_folder(folder / "rgb")
    entries, problems = _listed(listing)
    if not entries:
        raise nothing_listed(listing, "'stamp path', such as '12.34 rgb/12.34.png'", problems)
    return entries, problems


def _listed(listing: Path) -> tuple[list[ImageEntry], list[Problem]]:
    """Entries of a list of files beside it, in time order."""
    rows, problems = read_list(listing)
    paths = [listing.parent / name for _, name in rows]
    entries, more = entries_in_time([stamp for stamp, _ in rows], paths, str(listing))
    return entries, problems + more


def _depth(folder: Path) -> DepthMaps:
    """Maps of ``depth.txt``, whose comments may say ``value / 1000`` and ``not registered`` (then 7-Scenes' Kinect)."""
    listing = folder / DEPTH_LIST
    kept, problems = _listed(listing)
    said = " ".join(read_table(listing, SourceError).comments).lower()
    stated = re.search(r"value\s*/\s*(\d+)", said)
    units, remarks = (float(stated[1]), []) if stated else _units_per_metre(folder)
    other = "not registered" in said
    return DepthMaps(
        np.array([entry.stamp_s for entry in kept]),
        tuple(entry.path for entry in kept),
        1.0 / units,
        seven_scenes.DEPTH_CAMERA if other else None,
        seven_scenes.T_COLOUR_DEPTH if other else np.eye(4),
        (*problems, *remarks),
    )


def _units_per_metre(folder: Path) -> tuple[float, list[Problem]]:
    """``depth_scale`` (ORB-SLAM: ``DepthMapFactor``) of the folder's camera.yaml, else the 5000 of TUM's file format
    page and a remark."""
    file = folder / "camera.yaml"
    record = camera_keys(file) if file.is_file() else {}
    stated = next((record[key] for key in _DEPTH_SCALE_KEYS if key in record), None)
    if stated is None:
        reason = f"does not say the unit of its depth maps; taken as TUM's, {_TUM_UNITS_PER_METRE:.0f} to a metre"
        return _TUM_UNITS_PER_METRE, [Problem(str(folder / DEPTH_LIST), reason, frames=0)]
    if isinstance(stated, bool) or not isinstance(stated, int | float) or not 0 < stated < math.inf:
        raise CalibrationError(f"{file}: depth_scale must be a positive number, got {stated!r}")
    return float(stated), []
