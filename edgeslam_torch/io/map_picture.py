"""One picture of a run: the edge map and the trajectory from three sides."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from edgeslam_torch.io.atomic import write_atomically
from edgeslam_torch.types import FloatArray, PointCloud, Units

_BACKGROUND = "#11141a"
_INK = "#c9d1d9"
_PATH = "#ff9d2e"
_MIN_CELLS, _MAX_CELLS = 260, 700
"""Raster cells along the longer side of a view: points are splatted, so that a million cost what a few do."""

_EYE_TAN = 0.75
"""Half width of the camera's-eye view as a slope; a little wider than the cameras it is drawn for."""


def write_map_picture(path: Path, cloud: PointCloud, T_w_c: FloatArray, units: Units, title: str) -> None:
    """Draw the map from above (+z), from the side (across the scene's main direction) and as the camera saw it.

    Args:
        path: PNG to make.
        cloud: Edge map.
        T_w_c: ``(F, 4, 4)`` trajectory.
        units: For the axes.
        title: Over both.

    Raises:
        OSError: If the file cannot be written.
    """
    centres = np.asarray(T_w_c, dtype=np.float64).reshape(-1, 4, 4)[:, :3, 3]
    points, colour = _shown(cloud, centres)
    along = _main_direction(points if len(points) > 10 else centres)
    across = np.array([-along[1], along[0], 0.0])
    up = np.array([0.0, 0.0, 1.0])
    figure = Figure(figsize=(19, 6.6), dpi=100, facecolor=_BACKGROUND, layout="constrained")
    FigureCanvasAgg(figure)
    above, side, eye = figure.subplots(1, 3)
    unit = "m" if units is Units.METRES else "arbitrary units"
    for axes, name, upward in ((above, "from above", across), (side, "from the side", up)):
        basis = np.stack([along, upward], axis=1)
        _draw_view(axes, points @ basis, colour, centres @ basis)
        axes.set_title(name, color=_INK, fontsize=11)
        axes.set_xlabel(f"along the scene [{unit}]", color=_INK)
        axes.set_ylabel(f"{'across' if upward is across else 'height'} [{unit}]", color=_INK)
    _draw_eye(eye, cloud, T_w_c)
    figure.suptitle(title, color=_INK, fontsize=13)
    write_atomically(path, lambda file: figure.savefig(file, format="png", facecolor=_BACKGROUND))


def _shown(cloud: PointCloud, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points worth showing: finite, the far stragglers left out so that they do not set the picture's size."""
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
    sign = 1.0 if (x if abs(x) > abs(y) else y) > 0 else -1.0  # the eigenvector's own sign is arbitrary
    return np.array([sign * x, sign * y, 0.0])


def _draw_view(axes: Axes, points: FloatArray, colour: FloatArray, path: FloatArray) -> None:
    axes.set_facecolor(_BACKGROUND)
    for spine in axes.spines.values():
        spine.set_color("#3a414d")
    axes.tick_params(colors=_INK, labelsize=9)
    axes.grid(color="#262c36", linewidth=0.6)
    axes.set_axisbelow(True)
    if len(points):
        raster, extent = _splat(points, colour)
        axes.imshow(raster, extent=extent, origin="lower", interpolation="nearest", zorder=2)
    if len(path):
        axes.plot(path[:, 0], path[:, 1], color=_PATH, linewidth=1.6, zorder=3, label="camera")
        axes.scatter(path[0, 0], path[0, 1], s=36, color="#3fb950", zorder=4, label="start")
        axes.scatter(path[-1, 0], path[-1, 1], s=36, color="#f85149", zorder=4, label="end")
        axes.legend(facecolor=_BACKGROUND, edgecolor="#3a414d", labelcolor=_INK, fontsize=9, loc="upper right")
    axes.set_aspect("equal", adjustable="datalim")


def _draw_eye(axes: Axes, cloud: PointCloud, T_w_c: FloatArray) -> None:
    """The map as the camera saw it half-way through: what one should recognise."""
    axes.set_facecolor(_BACKGROUND)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_title("as the camera saw it half-way", color=_INK, fontsize=11)
    poses = np.asarray(T_w_c, dtype=np.float64).reshape(-1, 4, 4)
    finite = np.isfinite(cloud.p_w).all(axis=1)
    if len(poses) and finite.any():
        R, t = poses[len(poses) // 2, :3, :3], poses[len(poses) // 2, :3, 3]
        p_c = (np.asarray(cloud.p_w, dtype=np.float64)[finite] - t) @ R
        ahead = p_c[:, 2] > 1e-6
        slope = np.full((len(p_c), 2), np.inf)
        slope[ahead] = p_c[ahead, :2] / p_c[ahead, 2:]
        seen = (np.abs(slope[:, 0]) < _EYE_TAN) & (np.abs(slope[:, 1]) < 0.75 * _EYE_TAN)
        if seen.sum() > 1:
            flipped = slope[seen] * [1.0, -1.0]
            raster, extent = _splat(flipped, cloud.colour[finite][seen].astype(np.float64) / 255.0)
            axes.imshow(raster, extent=extent, origin="lower", interpolation="nearest")
    axes.set_xlim(-_EYE_TAN, _EYE_TAN)
    axes.set_ylim(-0.75 * _EYE_TAN, 0.75 * _EYE_TAN)
    axes.set_aspect("equal")


def _splat(points: FloatArray, colour: FloatArray) -> tuple[FloatArray, tuple[float, float, float, float]]:
    """Image ``(H, W, 4)`` of points ``(P, 2)`` in their mean colour, denser cells more opaque, and its extent."""
    low, high = points.min(axis=0), points.max(axis=0)
    cells_wide = float(np.clip(3.0 * np.sqrt(len(points)), _MIN_CELLS, _MAX_CELLS))
    cell = max(float((high - low).max()) / cells_wide, 1e-9)
    size = np.floor((high - low) / cell).astype(int) + 1
    index = np.minimum(((points - low) / cell).astype(int), size - 1)
    flat = index[:, 1] * size[0] + index[:, 0]
    cells = int(size[0] * size[1])
    count = np.bincount(flat, minlength=cells)
    raster = np.zeros((cells, 4))
    for channel in range(3):
        total = np.bincount(flat, weights=colour[:, channel], minlength=cells)
        raster[:, channel] = total / np.maximum(count, 1)
    # Dark edges on a dark page would not be seen: lift them, keeping their hue.
    raster[:, :3] = 0.30 + 0.70 * raster[:, :3]
    raster[:, 3] = np.where(count > 0, 0.45 + 0.55 * np.minimum(count / 3.0, 1.0), 0.0)
    extent = (low[0], low[0] + size[0] * cell, low[1], low[1] + size[1] * cell)
    return raster.reshape(size[1], size[0], 4), extent
