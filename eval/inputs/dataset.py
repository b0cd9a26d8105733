"""What an evaluation needs of a data set: true poses, image stamps, measured depth maps.

Three layouts: TUM RGB-D (``groundtruth.txt``, ``rgb.txt``, ``depth.txt``), 7-Scenes as published
(``frame-NNNNNN.{color,depth}.png`` and ``.pose.txt``), EuRoC (ground truth and image stamps, no depth).
"""

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import nearest
from edgeslam_torch.eval.inputs.trajectory_files import SEVEN_SCENES_HZ, Trajectory, read_trajectory
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import PRESETS, Camera, load_camera
from edgeslam_torch.readers.images import pixels_or_none
from edgeslam_torch.types import FloatArray

SEVEN_SCENES_DEPTH_CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0, source="7-Scenes depth camera")
"""https://www.microsoft.com/en-us/research/project/rgb-d-dataset-7-scenes/: (585, 585), (320, 240)."""

SEVEN_SCENES_T_C_D = se3.exp(np.array([-0.028, 0.003, 0.0, 0.0064, 0.0021, 0.0079]))
"""Depth camera to colour camera of the 7-Scenes Kinect, whose published depth maps are not registered to colour.

Fitted to redkitchen: depth discontinuities of 25 maps, moved by this and projected with the colour camera's 525 px, lie
nearest to the colour images' Canny edges (mean capped distance 3.78 px; translation alone 4.18; no motion 5.6, and a
free focal length comes out at 526). The 2.8 cm are the Kinect's known baseline.
"""

_TUM_DEPTH_PER_METRE = 5000.0
"""Of depth maps whose folder does not say: TUM's file format page."""

_MAX_TRUTH_GAP_S = 0.1
"""True poses are interpolated over gaps up to this long."""


@dataclass(frozen=True, slots=True)
class DepthFiles:
    """Measured depth maps of a data set."""

    stamps_s: FloatArray
    """``(D,)``."""
    paths: tuple[Path, ...]
    metres_per_unit: float
    camera: Camera
    """Camera that took the depth maps."""
    T_c_d: FloatArray
    """``(4, 4)`` depth camera to colour camera; identity when the maps are registered."""

    def read(self, index: int) -> FloatArray:
        """Depth map ``(H, W)`` [m] in undistorted pixels, 0 where nothing was measured.

        Raises:
            EvaluationError: If the file is not a 16-bit image.
        """
        raw = pixels_or_none(self.paths[index], cv2.IMREAD_UNCHANGED)
        if raw is None or raw.dtype != np.uint16 or raw.ndim != 2:
            raise EvaluationError(f"{self.paths[index]}: not a 16-bit depth map")
        depth: FloatArray = np.where(raw == 65535, 0, raw) * np.float32(self.metres_per_unit)
        depth = depth.astype(np.float32)
        if self.camera.is_distorted:
            maps = self.camera.undistortion_maps()
            return _remapped(depth, maps)
        return depth


@dataclass(frozen=True, slots=True)
class EvalDataset:
    """One recording with ground truth."""

    name: str
    folder: Path
    truth: Trajectory
    frame_stamps_s: FloatArray
    """``(F,)`` stamps of the colour images; empty when there are none."""
    image_paths: tuple[Path, ...]
    camera: Camera | None
    """Colour camera, when its calibration is known."""
    depth: DepthFiles | None


def _remapped(depth: FloatArray, maps: tuple[np.ndarray, np.ndarray]) -> FloatArray:
    """Nearest neighbour: a mean of two depths is a point in the air."""
    return np.asarray(cv2.remap(depth, *maps, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0))


def open_dataset(folder: Path | str) -> EvalDataset:
    """Data set with ground truth in any of the three layouts.

    Raises:
        EvaluationError: If the folder or its ground truth is missing or malformed.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise EvaluationError(f"{folder}: no such data set folder")
    if any(folder.glob("*.pose.txt")):
        return _open_seven_scenes(folder)
    if (folder / "mav0").is_dir():
        return _open_euroc(folder)
    if not (folder / "groundtruth.txt").is_file():
        raise EvaluationError(f"{folder}: no groundtruth.txt, *.pose.txt or mav0/ in this folder")
    return _open_tum(folder)


@dataclass(frozen=True, slots=True)
class MeasuredDepth:
    """A recording's depth maps beside its colour images; no true poses are needed."""

    files: DepthFiles
    frame_stamps_s: FloatArray
    """``(F,)`` stamps of the colour images."""
    image_paths: tuple[Path, ...]
    camera: Camera
    """Colour camera."""


def open_depth(folder: Path | str) -> MeasuredDepth:
    """Measured depth of a TUM or 7-Scenes recording.

    Raises:
        EvaluationError: If the folder has no depth maps, or its camera is not known.
    """
    folder = Path(folder)
    if any(folder.glob("*.depth.png")):
        images = tuple(sorted(folder.glob("*.color.png")))
        camera = _camera(folder) or PRESETS["kinect"]
        files = _seven_scenes_depth(folder)
        stamps = _frame_stamps(images)
    else:
        stamps, images, _ = _read_list(folder / "rgb.txt", folder)
        known = _camera(folder)
        if known is None and (folder / "depth.txt").is_file():
            raise EvaluationError(f"{folder}: the camera is not known; put a camera.yaml into the folder")
        camera = known or PRESETS["kinect"]
        files = _tum_depth(folder, camera)
    if files is None or len(stamps) == 0:
        raise EvaluationError(f"{folder}: no depth.txt and rgb.txt, nor *.depth.png, in this folder")
    return MeasuredDepth(files, stamps, images, camera)


def interpolate(trajectory: Trajectory, stamps_s: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Poses ``(N, 4, 4)`` at ``stamps_s`` and which of them lie within the trajectory's time and no long gap."""
    known = trajectory.stamps_s
    T = np.tile(np.eye(4), (len(stamps_s), 1, 1))
    if len(known) < 2:
        return T, np.zeros(len(stamps_s), dtype=bool)
    inside = np.clip(stamps_s, known[0], known[-1])
    T[:, :3, :3] = Slerp(known, Rotation.from_matrix(trajectory.T_w_c[:, :3, :3]))(inside).as_matrix()
    for axis in range(3):
        T[:, axis, 3] = np.interp(inside, known, trajectory.positions[:, axis])
    right = np.clip(np.searchsorted(known, inside), 1, len(known) - 1)
    exact = np.abs(known[nearest(known, stamps_s)] - stamps_s) < 1e-4
    return T, exact | ((known[right] - known[right - 1] <= _MAX_TRUTH_GAP_S) & (inside == stamps_s))


def _open_tum(folder: Path) -> EvalDataset:
    truth = read_trajectory(folder / "groundtruth.txt")
    stamps, images, _ = _read_list(folder / "rgb.txt", folder)
    camera = _camera(folder)
    depth = _tum_depth(folder, camera) if camera is not None else None
    return EvalDataset(folder.resolve().name, folder, truth, stamps, images, camera, depth)


def _tum_depth(folder: Path, camera: Camera) -> DepthFiles | None:
    if not (folder / "depth.txt").is_file():
        return None
    stamps, paths, header = _read_list(folder / "depth.txt", folder)
    divisor = re.search(r"/\s*(\d+)", header)
    unregistered = "not registered" in header.lower()
    return DepthFiles(
        stamps,
        paths,
        1.0 / (float(divisor.group(1)) if divisor else _depth_per_metre(folder)),
        SEVEN_SCENES_DEPTH_CAMERA if unregistered else camera,
        SEVEN_SCENES_T_C_D if unregistered else np.eye(4),
    )


def _depth_per_metre(folder: Path) -> float:
    """``depth_scale`` of the folder's camera.yaml, else the 5000 of TUM's file format page."""
    file = folder / "camera.yaml"
    record = read_mapping(file, "YAML", EvaluationError) if file.is_file() else {}
    stated = record.get("depth_scale", _TUM_DEPTH_PER_METRE)
    if not isinstance(stated, (int, float)) or not 0 < stated < np.inf:
        raise EvaluationError(f"{file}: depth_scale must be a positive number, got {stated!r}")
    return float(stated)


def _seven_scenes_depth(folder: Path) -> DepthFiles | None:
    paths = tuple(sorted(folder.glob("*.depth.png")))
    if not paths:
        return None
    return DepthFiles(_frame_stamps(paths), paths, 1e-3, SEVEN_SCENES_DEPTH_CAMERA, SEVEN_SCENES_T_C_D)


def _open_seven_scenes(folder: Path) -> EvalDataset:
    truth = read_trajectory(folder)
    images = tuple(sorted(folder.glob("*.color.png")))
    depth = _seven_scenes_depth(folder)
    camera = _camera(folder) or PRESETS["kinect"]
    name = "_".join(folder.resolve().parts[-2:])
    return EvalDataset(name, folder, truth, _frame_stamps(images), images, camera, depth)


def _open_euroc(folder: Path) -> EvalDataset:
    truth = read_trajectory(folder)
    listing = folder / "mav0" / "cam0" / "data.csv"
    stamps: FloatArray = np.zeros(0)
    images: tuple[Path, ...] = ()
    if listing.is_file():
        rows = [r.split(",") for r in listing.read_text().splitlines() if r.strip() and not r.startswith("#")]
        stamps = np.array([int(r[0]) for r in rows]) * 1e-9
        images = tuple(listing.parent / "data" / r[1].strip() for r in rows)
    return EvalDataset(folder.resolve().name, folder, truth, stamps, images, None, None)


def _frame_stamps(files: tuple[Path, ...]) -> FloatArray:
    numbers = ["".join(c for c in file.name.split(".")[0] if c.isdigit()) for file in files]
    return np.array([int(n or 0) for n in numbers]) / SEVEN_SCENES_HZ


def _camera(folder: Path) -> Camera | None:
    try:
        if (folder / "camera.yaml").is_file():
            return load_camera(folder / "camera.yaml")
    except CalibrationError as error:
        raise EvaluationError(str(error)) from error
    for number in (1, 2, 3):
        if f"freiburg{number}" in folder.resolve().name or f"fr{number}" in folder.resolve().name:
            return load_camera(f"tum_fr{number}")
    return None


def _read_list(path: Path, folder: Path) -> tuple[FloatArray, tuple[Path, ...], str]:
    """Stamps and files of a TUM list, and its comment lines."""
    if not path.is_file():
        return np.zeros(0), (), ""
    lines = path.read_text(encoding="utf-8").splitlines()
    header = " ".join(line for line in lines if line.startswith("#"))
    rows = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    try:
        return np.array([float(r[0]) for r in rows]), tuple(folder / r[1] for r in rows), header
    except (ValueError, IndexError) as error:
        raise EvaluationError(f"{path}: every line must be 'stamp file'") from error
