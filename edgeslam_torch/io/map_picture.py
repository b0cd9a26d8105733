"""One picture of a run: the edge map and the trajectory from above and from the side."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from edgeslam_torch.types import FloatArray, PointCloud, Units

_BACKGROUND = "#11141a"
_INK = "#c9d1d9"
_PATH = "#ff9d2e"
_PIXELS = 620
"""Raster columns of one view: points are splatted into an image, so that a million of them cost what a few do."""


def write_map_picture(path: Path, cloud: PointCloud, T_w_c: FloatArray, units: Units, title: str) -> None:
    """Draw top view (from +z) and side view (horizontally, across the main direction of the scene).

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
    figure = Figure(figsize=(14, 7), dpi=110, facecolor=_BACKGROUND, layout="constrained")
    FigureCanvasAgg(figure)
    views = (("from above", along, across), ("from the side", along, up))
    for axes, (name, right, upward) in zip(figure.subplots(1, 2), views, strict=True):
        basis = np.stack([right, upward], axis=1)
        _draw_view(axes, points @ basis, colour, centres @ basis)
        axes.set_title(name, color=_INK, fontsize=11)
        unit = "m" if units is Units.METRES else "arbitrary units"
        axes.set_xlabel(f"along the scene [{unit}]", color=_INK)
        axes.set_ylabel(f"{'across' if upward is across else 'height'} [{unit}]", color=_INK)
    figure.suptitle(title, color=_INK, fontsize=13)
    figure.savefig(path, format="png", facecolor=_BACKGROUND)


def _shown(cloud: PointCloud, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points worth showing: finite, the far stragglers left out so that they do not set the picture's size."""
    p = np.asarray(cloud.p_w, dtype=np.float64)
    finite = np.isfinite(p).all(axis=1)
    p, colour = p[finite], np.asarray(cloud.colour)[finite].astype(np.float64) / 255.0
    if len(p) < 10:
        return p, colour
    everything = np.concatenate([p, centres[np.isfinite(centres).all(axis=1)]])
    low, high = np.percentile(p, [1.0, 99.0], axis=0)
    margin = 0.15 * (high - low)
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


def _splat(points: FloatArray, colour: FloatArray) -> tuple[FloatArray, tuple[float, float, float, float]]:
    """Image ``(H, W, 4)`` of points ``(P, 2)`` in their mean colour, denser cells more opaque, and its extent."""
    low, high = points.min(axis=0), points.max(axis=0)
    cell = max(float((high - low).max()) / _PIXELS, 1e-9)
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
