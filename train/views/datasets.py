"""Training images with depth: folders in TUM layout, and anything that yields the same views."""

import logging
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml

from edgeslam_torch.errors import CalibrationError, SourceError
from edgeslam_torch.geometry.camera import Camera, load_camera
from edgeslam_torch.readers.images import pixels_or_none
from edgeslam_torch.train.processes.counting import counted
from edgeslam_torch.train.views.augment import View, fitted_view
from edgeslam_torch.types import FloatArray

logger = logging.getLogger(__name__)

MAX_SHOWN = 3
"""Files left out that are named in a message."""
NEAR_M, FAR_M = 0.05, 30.0
"""Depth that is learnt from."""


@dataclass(frozen=True, slots=True)
class DepthFolder:
    """Views of one folder, kept in memory at a size that suits the crops."""

    name: str
    views: Sequence[View]
    left_out: tuple[str, ...]
    """Files of no use, and why; training goes on without them."""


def load_depth_folder(
    folder: Path, width: int = 400, max_gap_s: float = 0.02, stride: int = 1, max_frames: int | None = None
) -> DepthFolder:
    """Read a folder in TUM layout (``rgb.txt``, ``depth.txt``, ``camera.yaml``), undistorted and scaled to ``width``.

    Each depth map is paired with the colour image nearest in time; depth is undistorted by nearest neighbour and holes
    (0, 65535) become 0.

    Args:
        folder: The recording.
        width: Images are reduced to this width [px] (never enlarged).
        max_gap_s: Largest time between colour and depth [s].
        stride: Take every ``stride``-th depth map.
        max_frames: Use only depth maps among the first colour images.

    Raises:
        SourceError: If a list is missing, or nothing can be learnt from.
        CalibrationError: If the calibration is missing or malformed.
    """
    folder = Path(os.path.abspath(folder))
    camera = load_camera(folder / "camera.yaml")
    scale = _depth_scale(folder / "camera.yaml")
    colours, depths = read_list(folder / "rgb.txt")[:max_frames], read_list(folder / "depth.txt")[::stride]
    pairs = _pairs(colours, depths, max_gap_s)
    views, left_out = [], []
    for colour_path, depth_path in counted(pairs, f"reading {folder.name}", "image"):
        view = _read_view(colour_path, depth_path, camera, scale)
        if isinstance(view, str):
            left_out.append(view)
        else:
            views.append(_reduced(view, width))
    if not views:
        why = f" ({left_out[0]})" if left_out else f" (no image within {max_gap_s:g} s of a depth map)"
        raise SourceError(f"{folder}: no image with depth could be read{why}")
    if left_out:
        shown = ", ".join(left_out[:MAX_SHOWN]) + (", ..." if len(left_out) > MAX_SHOWN else "")
        logger.warning("%s: %d of %d images with depth left out: %s", folder, len(left_out), len(pairs), shown)
    return DepthFolder(folder.name, views, tuple(left_out))


def _pairs(
    colours: Sequence[tuple[float, Path]], depths: Sequence[tuple[float, Path]], max_gap_s: float
) -> list[tuple[Path, Path]]:
    """Colour image and depth map, for each depth map with a colour image near it."""
    if not colours:
        return []
    stamps = np.array([t for t, _ in colours])
    nearest = [int(np.argmin(np.abs(stamps - stamp))) for stamp, _ in depths]
    found = zip(nearest, depths, strict=True)
    return [(colours[n][1], path) for n, (stamp, path) in found if abs(stamps[n] - stamp) <= max_gap_s]


def _read_view(colour_path: Path, depth_path: Path, camera: Camera, scale: float) -> View | str:
    """One image with its depth [m], undistorted; or which file is of no use, and why."""
    image = pixels_or_none(colour_path, cv2.IMREAD_COLOR)
    raw = pixels_or_none(depth_path, cv2.IMREAD_UNCHANGED)
    if image is None:
        return f"{colour_path}: unreadable"
    if raw is None or raw.ndim != 2:
        return f"{depth_path}: unreadable"
    for path, shape in ((colour_path, image.shape[:2]), (depth_path, raw.shape)):
        if shape != (camera.height, camera.width):
            return f"{path}: {shape[1]}x{shape[0]} px, calibrated for {camera.width}x{camera.height}"
    depth: FloatArray = np.where(raw == 65535, 0, raw).astype(np.float32) / scale
    if not ((depth > NEAR_M) & (depth < FAR_M)).any():
        return f"{depth_path}: no depth between {NEAR_M:g} and {FAR_M:g} m"
    if camera.is_distorted:
        maps = camera.undistortion_maps()
        image = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        undistorted = cv2.remap(depth, *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        depth = np.asarray(undistorted, np.float32)
    return View(np.asarray(image, np.uint8), np.asarray(depth, np.float32), camera.K)


def _depth_scale(calibration: Path) -> float:
    """Levels of a depth map per metre."""
    given = yaml.safe_load(calibration.read_text()).get("depth_scale", 1000.0)
    if not isinstance(given, int | float) or not np.isfinite(given) or given <= 0:
        raise CalibrationError(f"{calibration}: depth_scale must be a positive number, got {given!r}")
    return float(given)


def has_depth(folder: Path) -> bool:
    """Whether a folder is in TUM layout with depth maps."""
    return all((Path(folder) / name).is_file() for name in ("rgb.txt", "depth.txt", "camera.yaml"))


def read_list(path: Path) -> list[tuple[float, Path]]:
    """``timestamp filename`` lines of a TUM list, paths made absolute.

    Raises:
        SourceError: If the file is missing or a line cannot be parsed.
    """
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise SourceError(f"{path}: cannot read the list ({error.strerror})") from error
    entries = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.startswith("#"):
            continue
        try:
            stamp, name = line.split()[:2]
            entries.append((_finite(stamp), path.parent / name))
        except ValueError:
            raise SourceError(f"{path}:{number}: expected 'timestamp filename', got {line[:60]!r}") from None
    return entries


def _finite(text: str) -> float:
    """A number.

    Raises:
        ValueError: If it is none, or not finite.
    """
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value


def _reduced(view: View, width: int) -> View:
    h, w = view.image.shape[:2]
    if w <= width:
        return view
    return fitted_view(view, (round(h * width / w), width))
