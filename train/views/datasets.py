"""Training images with depth: recordings in any layout, and anything that yields the same views."""

import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.calibration.camera_choice import known_camera
from edgeslam_torch.errors import SourceError
from edgeslam_torch.eval.inputs.associate import DEFAULT_MAX_DT_S, nearest
from edgeslam_torch.eval.inputs.dataset import open_depth
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.images import pixels_or_none
from edgeslam_torch.readers.layouts import read_sequence
from edgeslam_torch.readers.listing import Problem
from edgeslam_torch.readers.sequence import DepthMaps
from edgeslam_torch.terminal.progress import counted
from edgeslam_torch.train.processes.distributed import rank
from edgeslam_torch.train.views.augment import View, fitted_view

logger = logging.getLogger(__name__)

MAX_SHOWN = 3
"""Maximum number of skipped files named in a message."""
NEAR_M, FAR_M = 0.05, 30.0
"""Range of depth used for training [m]."""


@dataclass(frozen=True, slots=True)
class DepthFolder:
    """Views of one folder, kept in memory at a size that suits the crops."""

    name: str
    views: Sequence[View]
    left_out: tuple[str, ...]
    """Skipped files with reasons."""
    sha256: str | None = None
    """Hash of the content, where reading all of it would take too long; None: of the views themselves."""


def load_depth_folder(folder: Path, width: int = 400, stride: int = 1, max_frames: int | None = None) -> DepthFolder:
    """Read a recording with depth maps, undistorted and scaled to ``width``.

    Each depth map is paired with the colour image nearest in time, and turned to its camera where it is not registered.

    Args:
        folder: The recording, in any layout.
        width: Images are reduced to this width [px] (never enlarged).
        stride: Take every ``stride``-th depth map.
        max_frames: Use only depth maps among the first colour images.

    Raises:
        EvaluationError: If there are no depth maps, or the calibration is missing or malformed.
        SourceError: If nothing can be learnt from.
    """
    folder = Path(os.path.abspath(folder))
    sequence, maps, camera = open_depth(folder)
    colours = sequence.images[:max_frames]
    stamps_s = np.array([entry.stamp_s for entry in colours])
    depths = np.arange(0, len(maps.stamps_s), stride)
    colour_of = nearest(stamps_s, maps.stamps_s[depths])
    near = np.abs(stamps_s[colour_of] - maps.stamps_s[depths]) <= DEFAULT_MAX_DT_S
    pairs = list(zip(colour_of[near].tolist(), depths[near].tolist(), strict=True))
    left_out = [_words(problem) for problem in (*sequence.problems, *maps.problems) if problem.frames]
    views = []
    for colour, depth in counted(pairs, f"reading {folder.name}", "image", shown=rank() == 0):
        view = _read_view(colours[colour].path, maps, depth, camera)
        if isinstance(view, str):
            left_out.append(view)
        else:
            views.append(reduced(view, width))
    if not views:
        why = f" ({left_out[0]})" if left_out else f" (no image within {DEFAULT_MAX_DT_S:g} s of a depth map)"
        raise SourceError(f"{folder}: no image with depth could be read{why}")
    for remark in (_words(problem) for problem in maps.problems if not problem.frames):
        logger.warning("%s", remark)
    warn_of(left_out, f"{folder}: {len(left_out)} images or depth maps left out")
    return DepthFolder(folder.name, views, tuple(left_out))


def warn_of(left_out: Sequence[str], what: str) -> None:
    """Log what was left out, if anything, with the first reasons."""
    if left_out:
        more = ", ..." if len(left_out) > MAX_SHOWN else ""
        logger.warning("%s: %s%s", what, ", ".join(left_out[:MAX_SHOWN]), more)


def has_depth(folder: Path) -> bool:
    """Whether a folder is a recording with depth maps, of a camera that is known.

    Raises:
        SourceError: If what names its images is malformed.
        CalibrationError: If its calibration is.
    """
    sequence = read_sequence(folder) if folder.is_dir() else None
    if sequence is None or sequence.depth is None:
        return False
    return known_camera((folder, sequence.folder), sequence.camera) is not None


def _read_view(colour_path: Path, maps: DepthMaps, index: int, camera: Camera) -> View | str:
    """One image with its depth [m], undistorted; or which file is of no use, and why."""
    image = pixels_or_none(colour_path, cv2.IMREAD_COLOR)
    if image is None:
        return f"{colour_path}: unreadable"
    if image.shape[:2] != (camera.height, camera.width):
        return f"{colour_path}: {image.shape[1]}x{image.shape[0]} px, calibrated for {camera.width}x{camera.height}"
    try:
        depth = maps.read_registered(index, camera)
    except SourceError as error:
        return str(error)
    if not ((depth > NEAR_M) & (depth < FAR_M)).any():
        return f"{maps.paths[index]}: no depth between {NEAR_M:g} and {FAR_M:g} m"
    if camera.is_distorted:
        undistortion = camera.undistortion_maps()
        image = cv2.remap(image, *undistortion, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return View(np.asarray(image, np.uint8), np.asarray(depth, np.float32), camera.K)


def _words(problem: Problem) -> str:
    return f"{problem.file}: {problem.reason}"


def reduced(view: View, width: int) -> View:
    """The view at most ``width`` pixels wide."""
    h, w = view.image.shape[:2]
    if w <= width:
        return view
    return fitted_view(view, (round(h * width / w), width))
