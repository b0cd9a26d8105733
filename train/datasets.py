"""Training images with depth: folders in TUM layout, and anything that yields the same views."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml

from edgeslam_torch.errors import SourceError
from edgeslam_torch.geometry.camera import load_camera
from edgeslam_torch.io.images import pixels_or_none
from edgeslam_torch.train.augment import View, fitted_view
from edgeslam_torch.types import FloatArray

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class DepthFolder:
    """Views of one folder, kept in memory at a size that suits the crops."""

    name: str
    views: Sequence[View]
    unreadable: tuple[str, ...]
    """Files that could not be read; training goes on without them."""


def load_depth_folder(
    folder: Path, width: int = 400, max_gap_s: float = 0.02, stride: int = 1, max_frames: int | None = None
) -> DepthFolder:
    """Read a folder in TUM layout (``rgb.txt``, ``depth.txt``, ``camera.yaml``), undistorted and scaled to
    ``width``.

    Each depth map is paired with the colour image nearest in time; depth is undistorted by nearest
    neighbour and holes
    (0, 65535) become 0.

    Args:
        folder: The recording.
        width: Images are reduced to this width [px] (never enlarged).
        max_gap_s: Largest time between colour and depth [s].
        stride: Take every ``stride``-th depth map.
        max_frames: Use only depth maps among the first colour images.

    Raises:
        SourceError: If a list or the calibration is missing, or nothing can be read.
    """
    folder = Path(folder)
    camera = load_camera(folder / "camera.yaml")
    scale = float(yaml.safe_load((folder / "camera.yaml").read_text()).get("depth_scale", 1000.0))
    colours, depths = read_list(folder / "rgb.txt"), read_list(folder / "depth.txt")
    colours = colours[:max_frames]
    stamps = np.array([t for t, _ in colours])
    views, unreadable = [], []
    for stamp, depth_path in depths[::stride]:
        nearest = int(np.argmin(np.abs(stamps - stamp)))
        if abs(stamps[nearest] - stamp) > max_gap_s:
            continue
        image = pixels_or_none(colours[nearest][1], cv2.IMREAD_COLOR)
        raw = pixels_or_none(depth_path, cv2.IMREAD_UNCHANGED)
        if image is None or raw is None or raw.ndim != 2:
            unreadable.append(str(colours[nearest][1] if image is None else depth_path))
            continue
        depth: FloatArray = np.where(raw == 65535, 0, raw).astype(np.float32) / scale
        maps = camera.undistortion_maps()
        if camera.is_distorted:
            image = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            undistorted = cv2.remap(depth, *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
            depth = np.asarray(undistorted, np.float32)
        view = View(np.asarray(image, np.uint8), np.asarray(depth, np.float32), camera.K)
        views.append(_reduced(view, width))
    if not views:
        raise SourceError(f"{folder}: no image with depth could be read")
    if unreadable:
        logger.warning("%s: %d unreadable files left out: %s", folder, len(unreadable), ", ".join(unreadable[:10]))
    return DepthFolder(folder.name, views, tuple(unreadable))


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
            entries.append((float(stamp), path.parent / name))
        except ValueError:
            raise SourceError(f"{path}:{number}: expected 'timestamp filename', got {line[:60]!r}") from None
    return entries


def _reduced(view: View, width: int) -> View:
    h, w = view.image.shape[:2]
    if w <= width:
        return view
    return fitted_view(view, (round(h * width / w), width))
