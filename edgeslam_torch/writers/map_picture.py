"""One picture of a run: the edge map and the trajectory from three sides."""

from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.types import FloatArray, PointCloud, Units
from edgeslam_torch.writers.raster_axes import (
    BACKGROUND,
    Axes,
    Image,
    axes_around,
    draw_dot,
    draw_frame,
    draw_grid,
    draw_legend,
    draw_path,
    draw_points,
    text,
)

_PATH, _START, _END = (255, 157, 46), (63, 185, 80), (248, 81, 73)
_WIDTH, _HEIGHT = 1900, 660
_BOX = (580, 562)
"""Size of one view."""
_TOP = 52
_LEFT = (66, 722, 1310)
"""Where the views begin."""
_MIN_CELLS, _MAX_CELLS = 260, 700
"""Squares along the longer side of a view; fewer points are drawn larger."""

_EYE_TAN = 0.75
"""Tangent of half the camera's-eye view angle; slightly wider than common cameras."""


def write_map_picture(
    path: Path, cloud: PointCloud, T_w_c: FloatArray, units: Units, title: str, level: bool = True
) -> None:
    """Draw the map from above (+z), from the side (across the scene's main direction) and as the camera saw it.

    Args:
        path: PNG to make.
        cloud: Edge map.
        T_w_c: ``(F, 4, 4)`` trajectory.
        units: Labels of the axes.
        title: Title of the picture.
        level: Whether z is known to be up.
    """
    picture: Image = np.full((_HEIGHT, _WIDTH, 3), BACKGROUND, dtype=np.uint8)
    centres = np.asarray(T_w_c, dtype=np.float64).reshape(-1, 4, 4)[:, :3, 3]
    points, colour = _shown(cloud, centres)
    along = _main_direction(points if len(points) > 10 else centres)
    across = np.array([-along[1], along[0], 0.0])
    unit = "m" if units is Units.METRES else "arbitrary units"
    for left, name, axis, upward in (
        (_LEFT[0], "from above" if level else "along z (up not known)", "across", across),
        (_LEFT[1], *(("from the side", "height") if level else ("across z (up not known)", "z")), np.eye(3)[2]),
    ):
        basis = np.stack([along, upward], axis=1)
        _draw_view(picture, (left, _TOP), points @ basis, colour, centres @ basis)
        middle = left + _BOX[0] / 2
        text(picture, name, (middle, _TOP - 12), 0.5, anchor=(0.5, 0.5))
        text(picture, f"along the scene [{unit}]", (middle, _HEIGHT - 11), 0.5, anchor=(0.5, 0.5))
        text(picture, f"{axis} [{unit}]", (left - 52, _TOP + _BOX[1] / 2), 0.5, anchor=(0.5, 0.5), upright=True)
    _draw_eye(picture, cloud, T_w_c)
    text(picture, title, (_WIDTH / 2, 14), 0.6, anchor=(0.5, 0.5))
    _, png = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    write_atomically(path, lambda file: file.write(png.tobytes()))


def _shown(cloud: PointCloud, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Finite points without far outliers, which would determine the picture's scale."""
    p = np.asarray(cloud.p_w, dtype=np.float64)
    finite = np.isfinite(p).all(axis=1)
    p, colour = p[finite], np.asarray(cloud.colour)[finite].astype(np.float64) / 255.0
    if len(p) < 10:
        return p, colour
    everything = np.concatenate([p, centres[np.isfinite(centres).all(axis=1)]])
    low, high = np.percentile(p, [2.0, 98.0], axis=0)
    margin = 0.1 * (high - low)
    low = np.minimum(low - margin, everything[len(p) :].min(axis=0, initial=np.inf))
    high = np.maximum(high + margin, everything[len(p) :].max(axis=0, initial=-np.inf))
    inside = ((p >= low) & (p <= high)).all(axis=1)
    return p[inside], colour[inside]


def _main_direction(p: FloatArray) -> FloatArray:
    """Unit horizontal direction in which the points spread most."""
    flat = p[np.isfinite(p).all(axis=1), :2]
    if len(flat) < 2 or np.allclose(flat, flat[0]):
        return np.array([1.0, 0.0, 0.0])
    _, vectors = np.linalg.eigh(np.cov(flat.T))
    x, y = vectors[:, -1]
    sign = 1.0 if (x if abs(x) > abs(y) else y) > 0 else -1.0  # the sign of an eigenvector is arbitrary
    return np.array([sign * x, sign * y, 0.0])


def _part(picture: Image, corner: tuple[int, int], size: tuple[int, int]) -> Image:
    (x, y), (width, height) = corner, size
    return picture[y : y + height, x : x + width]


def _draw_view(
    picture: Image, corner: tuple[int, int], points: FloatArray, colour: FloatArray, path: FloatArray
) -> None:
    axes = axes_around(_part(picture, corner, _BOX), np.concatenate([points, path]))
    draw_grid(axes, picture, corner)
    if len(points):
        draw_points(axes, points, colour, _cell_px(axes, points))
    if len(path):
        draw_path(axes, path, _PATH, 2)
        draw_dot(axes, path[0], _START, 4.5)
        draw_dot(axes, path[-1], _END, 4.5)
        draw_legend(axes, [("camera", _PATH, True), ("start", _START, False), ("end", _END, False)])


def _draw_eye(picture: Image, cloud: PointCloud, T_w_c: FloatArray) -> None:
    """The map as the camera saw it half-way through the run."""
    size = (_BOX[0], round(0.75 * _BOX[0]))
    corner = (_LEFT[2], _TOP + (_BOX[1] - size[1]) // 2)
    text(picture, "as the camera saw it half-way", (corner[0] + size[0] / 2, corner[1] - 12), 0.5, anchor=(0.5, 0.5))
    draw_frame(picture, corner, size)
    edge = _EYE_TAN * np.array([1.0, 0.75])
    axes = axes_around(_part(picture, corner, size), np.stack([-edge, edge]), margin=0.0)
    poses = np.asarray(T_w_c, dtype=np.float64).reshape(-1, 4, 4)
    finite = np.isfinite(cloud.p_w).all(axis=1)
    if not len(poses) or not finite.any():
        return
    R, t = poses[len(poses) // 2, :3, :3], poses[len(poses) // 2, :3, 3]
    p_c = (np.asarray(cloud.p_w, dtype=np.float64)[finite] - t) @ R
    ahead = p_c[:, 2] > 1e-6
    slope = p_c[ahead, :2] / p_c[ahead, 2:] * [1.0, -1.0]
    seen = (np.abs(slope) < edge).all(axis=1)
    if seen.any():
        colour = cloud.colour[finite][ahead][seen].astype(np.float64) / 255.0
        draw_points(axes, slope[seen], colour, _cell_px(axes, slope[seen]))


def _cell_px(axes: Axes, points: FloatArray) -> int:
    """Side of the squares that represent points ``(N, 2)``; smaller for more points."""
    span_px = axes.scale * float(np.ptp(points, axis=0).max())
    return max(1, round(span_px / np.clip(3.0 * np.sqrt(len(points)), _MIN_CELLS, _MAX_CELLS)))
