"""Poses and sparse depth of a SLAM run, for self-supervised training."""

import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import SourceError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.run_folder import is_supported, open_run
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.terminal.progress import Progress
from edgeslam_torch.train.processes.distributed import rank
from edgeslam_torch.train.views.augment import View, fitted_view
from edgeslam_torch.types import FloatArray

MIN_PARALLAX, MAX_PARALLAX = 0.02, 0.2
"""Baseline over median depth of useful pairs: below, parallax is too small; above, too much is occluded."""
MAX_ROTATION_RAD = 0.35
_CELL = 20
"""Side of the cells [px of the reduced image] in which the nearest point hides those well behind it."""
_BEHIND = 1.2
MIN_POINTS, MIN_VIEWS = 30, 8
"""Minimum map points per view, and views per run."""


class TooFewViews(SourceError):
    """A run that no network can learn from: it hardly tracked, or its camera saw nothing."""


@dataclass(frozen=True, slots=True)
class PosedView:
    """One undistorted image with its pose and the map points seen in it."""

    name: str
    image: NDArray[np.uint8]
    """``(H, W, 3)`` BGR."""
    K: FloatArray
    T_w_c: FloatArray
    uv: FloatArray
    """``(N, 2)`` float32 [px]."""
    z: FloatArray
    """``(N,)`` z-depths in the trajectory's unit, float32."""


@dataclass(frozen=True, slots=True)
class PosedSequence:
    """Views in order, with the partners that each can be compared with."""

    name: str
    views: Sequence[PosedView]
    partners: Sequence[tuple[int, ...]]
    metric: bool
    """Whether the trajectory is in metres."""

    @property
    def usable(self) -> list[int]:
        """Views with at least one partner."""
        return [i for i, p in enumerate(self.partners) if p]


def is_run_folder(folder: Path) -> bool:
    """Whether ``edgeslam run`` wrote this folder."""
    return (folder / "summary.json").is_file() and (folder / "trajectory.txt").is_file()


def load_run(folder: Path, width: int = 320, max_views: int = 600, max_frames: int | None = None) -> PosedSequence:
    """Images of the recording that a run was made from, with the run's poses and map.

    Of a run in several unrelated pieces, the one with the most frames.

    Args:
        folder: Output of ``edgeslam run``.
        width: Images are reduced to this width.
        max_views: Views kept, evenly spread.
        max_frames: Use only the first frames of the recording.

    Raises:
        TooFewViews: If too few views have points.
        SourceError: If the folder is no run's, or the recording is gone.
    """
    folder = Path(os.path.abspath(folder))
    try:
        run = open_run(folder)
        recording = str(folder.resolve() / run.summary["source"]["path"])
    except (EvaluationError, KeyError, TypeError) as error:
        raise SourceError(f"{folder}: not the output of 'edgeslam run' ({type(error).__name__}: {error})") from error
    clouds = [cloud.p_w for name in ("anchors.ply", "edge_map.ply") if (cloud := run.cloud(name)) is not None]
    points = np.concatenate(clouds) if clouds else np.zeros((0, 3), np.float32)
    tracked = {round(float(row["stamp_s"]), 6) for row in run.pose_rows if is_supported(row)}
    poses = zip(run.trajectory.stamps_s.tolist(), run.trajectory.T_w_c, strict=True)
    kept = {round(t, 6): T for t, T in poses if not run.status or round(t, 6) in tracked}
    camera = folder / "camera.yaml"
    opened = open_source(recording, camera if camera.is_file() else None, max_frames=max_frames)
    step = max(len(run.trajectory) // max_views, 1)
    count = Progress(f"reading {folder.name}", opened.length or len(run.trajectory), "image", shown=rank() == 0)
    views = []
    with closing(opened), closing(count):
        for frame in opened.frames():
            T_w_c = kept.get(round(frame.stamp_s, 6))
            if T_w_c is not None and frame.index % step == 0:
                name = frame.path.name if frame.path else str(frame.index)
                views.append(_view(name, frame.image, opened.camera, T_w_c, points, width))
            count.advance()
    views = [v for v in views if len(v.z) >= MIN_POINTS]
    if len(views) < MIN_VIEWS:
        raise TooFewViews(
            f"{folder}: only {len(views)} frames of {recording} have a pose and {MIN_POINTS} map points in view, "
            f"{MIN_VIEWS} are needed"
        )
    return PosedSequence(folder.name, views, find_partners(views), run.units == "metres")


def find_partners(views: Sequence[PosedView], reach: int = 40, most: int = 8) -> list[tuple[int, ...]]:
    """For each view those nearby with a useful baseline and little rotation, before and after it."""
    centres = np.array([v.T_w_c[:3, 3] for v in views])
    forward = np.array([v.T_w_c[:3, :3] for v in views])
    found = []
    for i, view in enumerate(views):
        window = np.array([j for j in range(max(0, i - reach), min(len(views), i + reach + 1)) if j != i])
        parallax = np.linalg.norm(centres[window] - centres[i], axis=1) / np.median(view.z)
        cosine = (np.einsum("jab,ab->j", forward[window], forward[i]) - 1) / 2
        good = window[(parallax > MIN_PARALLAX) & (parallax < MAX_PARALLAX) & (cosine > np.cos(MAX_ROTATION_RAD))]
        pick = good[np.linspace(0, len(good) - 1, min(most, len(good))).astype(int)] if len(good) else good
        found.append(tuple(int(j) for j in pick))
    return found


def visible_points(
    p_w: FloatArray, K: FloatArray, T_w_c: FloatArray, size: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(N, 2)`` and depths ``(N,)`` of the map points that a view ``size = (height, width)`` sees.

    A run does not store observations. A point counts as occluded when another one in its cell or the eight around it
    is much nearer; this discards background beside foreground.
    """
    height, width = size
    p_c = (p_w - T_w_c[:3, 3]) @ T_w_c[:3, :3]
    p_c = p_c[p_c[:, 2] > 0.05]
    uv = p_c[:, :2] / p_c[:, 2:] * K.diagonal()[:2] + K[:2, 2]
    inside = ((uv >= 0) & (uv <= (width - 1, height - 1))).all(1)
    uv, z = uv[inside], p_c[inside, 2]
    rows, columns = height // _CELL + 1, width // _CELL + 1
    cell = (uv[:, 1] // _CELL).astype(int) * columns + (uv[:, 0] // _CELL).astype(int)
    nearest = np.full(rows * columns, np.inf, np.float32)
    np.minimum.at(nearest, cell, z.astype(np.float32))
    # Erosion is the minimum over the 3 x 3 cells around.
    around = cv2.erode(nearest.reshape(rows, columns), np.ones((3, 3), np.uint8)).ravel()
    kept = z < _BEHIND * around[cell]
    return uv[kept].astype(np.float32), z[kept].astype(np.float32)


def _view(
    name: str, image: NDArray[np.uint8], camera: Camera, T_w_c: FloatArray, p_w: FloatArray, width: int
) -> PosedView:
    image = np.asarray(camera.undistort_image(image), np.uint8)
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=2)
    view = View.without_depth(image, camera.K)
    if camera.width > width:
        view = fitted_view(view, (round(camera.height * width / camera.width), width))
    uv, z = visible_points(p_w, view.K, T_w_c, (view.image.shape[0], view.image.shape[1]))
    return PosedView(name, view.image, view.K, T_w_c, uv, z)


def relative_motion(view_i: PosedView, view_j: PosedView) -> FloatArray:
    """``T_j_i (4, 4)``: camera i to camera j."""
    return se3.inverse(view_j.T_w_c) @ view_i.T_w_c
