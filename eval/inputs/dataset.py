"""Ground truth of a data set: poses, image stamps, measured depth maps.

`edgeslam_torch.readers.layouts` reads the folder, as it does for SLAM and training; the poses are read here.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edgeslam_torch.calibration.camera_choice import known_camera
from edgeslam_torch.errors import CalibrationError, EdgeSlamError, SourceError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import nearest
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, read_trajectory
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.rotations import matrices_from_vectors, vectors_from_matrices
from edgeslam_torch.readers.layouts import read_sequence
from edgeslam_torch.readers.sequence import DepthMaps, Sequence
from edgeslam_torch.types import FloatArray

_MAX_TRUTH_GAP_S = 0.1
"""True poses are interpolated over gaps up to this long."""


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
    depth: DepthMaps | None
    """None without depth maps, or when the camera is not known."""


def open_dataset(folder: Path | str) -> EvalDataset:
    """Data set with ground truth in any layout; true poses alone will do.

    Raises:
        EvaluationError: If the folder or its ground truth is missing or malformed.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise EvaluationError(f"{folder}: no such data set folder")
    sequence, camera, depth = _opened(folder)
    if sequence is None:
        sequence = Sequence("poses", folder, (), groundtruth=_poses_alone(folder))
    if sequence.groundtruth is None:
        raise EvaluationError(f"{folder}: no true poses in this folder, such as groundtruth.txt")
    stamps = sequence.groundtruth_stamps_s
    truth = read_trajectory(sequence.groundtruth, None if stamps is None else np.array(stamps))
    frames = np.array([entry.stamp_s for entry in sequence.images])
    paths = tuple(entry.path for entry in sequence.images)
    return EvalDataset(sequence.name, folder, truth, frames, paths, camera, depth)


def open_depth(folder: Path | str) -> tuple[Sequence, DepthMaps, Camera]:
    """A recording with its depth maps and its colour camera; no true poses are needed.

    Raises:
        EvaluationError: If the folder has no depth maps, or its camera is not known.
    """
    folder = Path(folder)
    sequence, camera, depth = _opened(folder)
    if sequence is None or sequence.depth is None or not sequence.images:
        raise EvaluationError(f"{folder}: no depth.txt and rgb.txt, nor *.depth.png, in this folder")
    if camera is None or depth is None:
        raise EvaluationError(f"{folder}: the camera is not known; put a camera.yaml into the folder")
    return sequence, depth, camera


def find_recordings(data: Path, min_frames: int = 30, min_hz: float = 0.0) -> dict[str, tuple[Path, FloatArray]]:
    """Recordings with ground truth and images, by name: folder and stamps of the images.

    ``data`` itself, its folders and theirs are looked at.

    Raises:
        EvaluationError: If ``data`` is no folder.
    """
    if not data.is_dir():
        raise EvaluationError(f"{data}: no such folder of recordings (DATA, --data or EDGESLAM_DATA)")
    found: dict[str, tuple[Path, FloatArray]] = {}
    children = sorted(p for p in data.iterdir() if p.is_dir())
    for folder in (data, *children, *(g for child in children for g in sorted(child.iterdir()) if g.is_dir())):
        if any(folder.is_relative_to(other) for other, _ in found.values()):  # a part of a recording
            continue
        try:
            dataset = open_dataset(folder)
        except EdgeSlamError:
            continue
        stamps = dataset.frame_stamps_s
        if len(stamps) >= max(min_frames, 2) and min_hz * float(np.median(np.diff(stamps))) <= 1.0:
            name = dataset.name if dataset.name not in found else f"{folder.parent.name}_{dataset.name}"
            found[name] = (folder, stamps)
    return {name: (folder.resolve(), stamps) for name, (folder, stamps) in found.items()}


def interpolate(trajectory: Trajectory, stamps_s: FloatArray) -> tuple[FloatArray, np.ndarray]:
    """Poses ``(N, 4, 4)`` at ``stamps_s`` and which of them lie within the trajectory's time and no long gap.

    Raises:
        EvaluationError: If the trajectory has positions alone.
    """
    if not trajectory.oriented:
        raise EvaluationError(f"{trajectory.source}: positions without orientations, which are needed here")
    known = trajectory.stamps_s
    T = np.tile(np.eye(4), (len(stamps_s), 1, 1))
    if len(known) < 2:
        return T, np.zeros(len(stamps_s), dtype=bool)
    inside = np.clip(stamps_s, known[0], known[-1])
    for axis in range(3):
        T[:, axis, 3] = np.interp(inside, known, trajectory.positions[:, axis])
    right = np.clip(np.searchsorted(known, inside), 1, len(known) - 1)
    share = ((inside - known[right - 1]) / (known[right] - known[right - 1]))[:, None]
    R, R_next = (trajectory.T_w_c[i, :3, :3] for i in (right - 1, right))
    turn = vectors_from_matrices(np.swapaxes(R, 1, 2) @ R_next)
    T[:, :3, :3] = R @ matrices_from_vectors(share * turn)
    exact = np.abs(known[nearest(known, stamps_s)] - stamps_s) < 1e-4
    return T, exact | ((known[right] - known[right - 1] <= _MAX_TRUTH_GAP_S) & (inside == stamps_s))


def _opened(folder: Path) -> tuple[Sequence | None, Camera | None, DepthMaps | None]:
    """The recording in a folder, its colour camera, and with one its depth maps."""
    try:
        sequence = read_sequence(folder)
        if sequence is None:
            return None, None, None
        camera = known_camera((folder, sequence.folder), sequence.camera)
        depth = None if camera is None or sequence.depth is None else sequence.depth()
    except (SourceError, CalibrationError) as error:
        raise EvaluationError(str(error)) from error
    return sequence, camera, depth


def _poses_alone(folder: Path) -> Path:
    """True poses in a folder without images."""
    if any(folder.glob("*.pose.txt")) or (folder / "mav0").is_dir():
        return folder
    if (folder / "groundtruth.txt").is_file():
        return folder / "groundtruth.txt"
    raise EvaluationError(f"{folder}: no groundtruth.txt, *.pose.txt or mav0/ in this folder")
