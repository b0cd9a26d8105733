"""A recording on disk: images with time stamps, and the files beside them.

SLAM, evaluation and training all read recordings through this record; `edgeslam_torch.readers.layouts` makes it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.images import read_pixels
from edgeslam_torch.readers.listing import ImageEntry, Problem
from edgeslam_torch.types import FloatArray

NOTHING_MEASURED = (0, 65535)
"""Values of a depth map that mean "no measurement"."""


@dataclass(frozen=True, slots=True)
class DepthMaps:
    """Measured depth maps beside the images: one channel, 16 bits."""

    stamps_s: FloatArray
    """``(D,)``."""
    paths: tuple[Path, ...]
    metres_per_unit: float
    camera: Camera | None = None
    """Camera that took them; None when they are registered to the colour images."""
    T_c_d: FloatArray = field(default_factory=lambda: np.eye(4))
    """``(4, 4)`` depth camera to colour camera; identity when they are registered."""
    problems: tuple[Problem, ...] = ()
    """Skipped entries with reasons, and remarks."""

    @property
    def is_registered(self) -> bool:
        """Whether the maps are aligned with the colour images."""
        return self.camera is None

    def taken_by(self, colour: Camera) -> Camera:
        """The camera that took the maps: ``colour`` itself when they are registered."""
        return colour if self.camera is None else self.camera

    def read(self, index: int, colour: Camera) -> FloatArray:
        """Depth map ``(H, W)`` float32 [m] in undistorted pixels of `taken_by`, 0 where nothing was measured.

        Raises:
            SourceError: If the file is missing, no 16-bit image, or of another size than the camera's.
        """
        path, camera = self.paths[index], self.taken_by(colour)
        raw = read_pixels(path, cv2.IMREAD_UNCHANGED)
        if raw.dtype != np.uint16 or raw.ndim != 2:
            raise SourceError(f"{path}: not a 16-bit depth map")
        if raw.shape != (camera.height, camera.width):
            raise SourceError(
                f"{path}: {raw.shape[1]}x{raw.shape[0]} px, calibrated for {camera.width}x{camera.height}"
            )
        metres = np.where(np.isin(raw, NOTHING_MEASURED), 0, raw) * np.float32(self.metres_per_unit)
        if not camera.is_distorted:
            return np.asarray(metres, np.float32)
        # Nearest neighbour: interpolation across a depth discontinuity would create points in mid-air.
        maps, flat = camera.undistortion_maps(), metres.astype(np.float32)
        straight = cv2.remap(flat, *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(straight, np.float32)

    def read_registered(self, index: int, colour: Camera) -> FloatArray:
        """As `read`, ``(H, W)`` in undistorted pixels of the colour camera.

        Raises:
            SourceError: As `read`.
        """
        depth = self.read(index, colour)
        return depth if self.is_registered else register_depth(depth, self.taken_by(colour), self.T_c_d, colour)


@dataclass(frozen=True, slots=True)
class Sequence:
    """One recording on disk."""

    kind: str
    """Name of its layout."""
    folder: Path
    """Folder of the images' calibration file."""
    images: tuple[ImageEntry, ...]
    """In time order."""
    problems: tuple[Problem, ...] = ()
    """Skipped images with reasons, and remarks."""
    groundtruth: Path | None = None
    """A file of true poses, or a folder of them; `edgeslam_torch.eval.inputs.trajectory_files` reads it."""
    groundtruth_stamps_s: tuple[float, ...] | None = None
    """Stamps of a ground truth whose file has none."""
    camera: Camera | None = None
    """The data set's default calibration; a calibration file in the folder takes precedence."""
    depth: Callable[[], DepthMaps] | None = None
    """Function that lists the measured depth maps; None without any."""
    name: str = ""
    """The folder's name by default."""

    def __post_init__(self) -> None:
        if not self.name:
            object.__setattr__(self, "name", self.folder.resolve().name)

    def first(self, count: int | None) -> "Sequence":
        """The recording's first ``count`` images."""
        return self if count is None else replace(self, images=self.images[:count])


def register_depth(depth: FloatArray, depth_camera: Camera, T_c_d: FloatArray, camera: Camera) -> FloatArray:
    """Depth map ``(H, W)`` of one camera rendered in another; 0 where empty, else the nearest depth."""
    v, u = np.nonzero(depth)
    p_d = depth_camera.back_project(np.stack([u, v], axis=1).astype(np.float64), depth[v, u])
    p = p_d @ T_c_d[:3, :3].T + T_c_d[:3, 3]
    p = p[p[:, 2] > 0.05]
    uv = np.rint(camera.project(p)).astype(np.int64)
    ok = (uv >= 0).all(axis=1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    out = np.full((camera.height, camera.width), np.inf, dtype=np.float32)
    np.minimum.at(out, (uv[ok, 1], uv[ok, 0]), p[ok, 2].astype(np.float32))
    out[np.isinf(out)] = 0.0
    return out
