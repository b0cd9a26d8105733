"""Per-frame alignment of network depth to the map's scale, with a standard deviation from the fit.

Outside its training domain a depth network is biased by tens of percent and compresses the depth range: near surfaces
are predicted too far away, which is unsafe. Map points in the same frame determine both errors.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage

from edgeslam_torch.types import DepthMap, FloatArray

MIN_POINTS = 20
_ROUNDS = 6
_HUBER = 1.5
_SLOPE_SIGMA = 0.3
"""Standard deviation of the slope's prior around 1."""
_LEAST_SIGMA = 0.03
_SLOPES = (0.6, 2.0)
_NEAR_SHARE = 0.06
"""Smoothing radius in image widths: 4 degrees of a Tello's camera; network errors correlate over it."""
ALONE_SIGMA = 0.3
"""Standard deviation of log depth without map points."""
_BIAS_SIGMA = 0.2
"""The same if the frame's points agree with the bias estimate; away from the points (measured at 0.8 to 3 m)."""
_LINE_POINTS = 3.0
"""Weight of the line, in points."""
_BLOCK, _STRIDE = 8, 4
"""Cell size of the bilateral grid and pixel stride of its evaluation [px]."""
_LEVEL_LOG, _BEYOND = 0.2, 3
"""Cell size in log depth, and empty cells before and behind all points."""


_INDEPENDENT = 5.0
"""Effective number of independent errors in one frame: bound of the points' total weight against the bias line."""


@dataclass(frozen=True, slots=True)
class NearFit:
    """``log depth = offset + slope * log network depth``."""

    offset: float
    slope: float
    sigma_log: float
    """Robust standard deviation of single points around the line."""
    points: int
    uv: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """``(P, 2)`` pixels of the points; empty if unknown."""
    level: FloatArray = field(default_factory=lambda: np.zeros(0))
    """``(P,)`` log depth by the line."""
    residual: FloatArray = field(default_factory=lambda: np.zeros(0))
    """``(P,)`` log map depth less log depth by the line."""
    bends: bool = False
    """Whether the line is the bias estimate, corrected towards the points at their depths."""

    @property
    def network_log(self) -> FloatArray:
        """``(P,)`` log network depth at the points."""
        return (self.level - self.offset) / self.slope

    @property
    def ratio_log(self) -> float:
        """Median over the points of log map depth less log network depth."""
        return float(np.median(self.level + self.residual - self.network_log))

    def alone(self) -> "NearFit":
        """The line without its points, for another frame."""
        return NearFit(self.offset, self.slope, self.sigma_log, self.points)

    def through(self, points: "NearFit") -> "NearFit":
        """The bias line with the points of one frame; beyond their depths the line itself holds, so that errors on a
        wall do not extrapolate to the room behind a door."""
        level = self.offset + self.slope * points.network_log
        residual = points.level + points.residual - level
        spread = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), _LEAST_SIGMA)
        return NearFit(self.offset, self.slope, spread, points.points, points.uv, level, residual, bends=True)

    def applied(self, depth: DepthMap) -> DepthMap:
        """Depth in map units, corrected by nearby points; unknown where the network's depth is.

        The standard deviation is the spread of nearby points, and the network's own far from all points.
        """
        known = np.isfinite(depth.depth_m) & (depth.depth_m > 0)
        log_m = self.offset + self.slope * np.log(np.where(known, depth.depth_m, 1.0))
        level, residual = self.level, self.residual
        if self.bends:
            bend = _bend(level, residual)
            log_m = log_m + bend(log_m)
            level = level + bend(level)
            residual = self.level + self.residual - level
        alone = _BIAS_SIGMA if self.bends else ALONE_SIGMA
        error, sigma = local_error(self.uv, level, residual, self.sigma_log, log_m, alone)
        metres = np.where(known, np.exp(log_m + error), np.nan).astype(np.float32)
        return DepthMap(metres, sigma)


def fit_near(network_m: FloatArray, map_m: FloatArray) -> NearFit | None:
    """Robust line fit of log map depth against log network depth, ``(N,)`` each.

    Huber weights, prior slope 1; None with fewer than `MIN_POINTS` points.
    """
    usable = np.isfinite(network_m) & np.isfinite(map_m) & (network_m > 0) & (map_m > 0)
    if int(usable.sum()) < MIN_POINTS:
        return None
    x, y = np.log(network_m[usable]), np.log(map_m[usable])
    middle = float(np.median(x))
    A = np.stack([np.ones_like(x), x - middle], axis=1)
    line, spread = np.array([float(np.median(y - x)) + middle, 1.0]), 0.3
    for _ in range(_ROUNDS):
        residual = y - A @ line
        spread = max(1.4826 * float(np.median(np.abs(residual))), _LEAST_SIGMA)
        weight = np.minimum(1.0, _HUBER * spread / np.maximum(np.abs(residual), 1e-9))
        normal = (A * weight[:, None]).T @ A
        normal[1, 1] += (spread / _SLOPE_SIGMA) ** 2
        right = (A * weight[:, None]).T @ y + [0.0, (spread / _SLOPE_SIGMA) ** 2]
        line = np.linalg.solve(normal, right)
    slope = float(np.clip(line[1], *_SLOPES))
    return NearFit(float(line[0] - slope * middle), slope, spread, int(usable.sum()))


def _bend(level: FloatArray, residual: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Error of a line as a function of log depth: Gaussian kernel regression of bandwidth `_LEVEL_LOG`, shrunk to 0.

    Outliers, mostly occlusions, get Huber weights.
    """
    off = np.abs(residual - np.median(residual))
    bound = _HUBER * max(1.4826 * float(np.median(off)), _LEAST_SIGMA)
    weight = np.minimum(1.0, bound / np.maximum(off, 1e-9)) * _INDEPENDENT / len(level)
    step = _LEVEL_LOG / 16.0
    knots = np.arange(float(level.min()) - 1.0, float(level.max()) + 1.0, step)
    coarse = knots[::4]
    kernel = weight * np.exp(-0.5 * ((coarse[:, None] - level) / _LEVEL_LOG) ** 2)
    error = np.interp(knots, coarse, kernel @ residual / (kernel.sum(axis=1) + 1.0)).astype(np.float32)

    def bend(at: FloatArray) -> FloatArray:
        nearest = ((at - (knots[0] - 0.5 * step)) * np.float32(1.0 / step)).astype(np.int32)
        return error[np.clip(nearest, 0, len(knots) - 1)]

    return bend


def local_error(
    uv: FloatArray,
    level: FloatArray,
    residual: FloatArray,
    spread: float,
    log_m: FloatArray,
    alone_sigma: float = ALONE_SIGMA,
) -> tuple[FloatArray, FloatArray]:
    """Error of a line at every pixel and its standard deviation, from points ``(P, 2)`` with residuals ``(P,)``.

    Gaussian kernel regression over `_NEAR_SHARE` of the image width and `_LEVEL_LOG` in depth (bilateral grid: Chen,
    Paris and Durand 2007), shrunk to 0 with the weight of `_LINE_POINTS` points. The depth dimension keeps points on a
    door frame from correcting the room behind it. Points more than three standard deviations behind the line are
    occluded and left out.

    Args:
        uv: Pixels of the points.
        level: Log depth by the line at the points ``(P,)``.
        residual: Log map depth less ``level``.
        spread: Robust standard deviation of the residuals.
        log_m: Log depth by the line at every pixel ``(H, W)``.
        alone_sigma: Standard deviation of log depth without points.

    Returns:
        Error and standard deviation ``(H, W)`` float32 each.
    """
    height, width = log_m.shape
    kept = residual < 3.0 * spread
    lowest = float(level[kept].min()) if kept.any() else 0.0
    levels = int((float(level[kept].max()) - lowest) / _LEVEL_LOG) + 1 + 2 * _BEYOND if kept.any() else 1
    small = (-(-height // _BLOCK), -(-width // _BLOCK), levels)

    def place(u: FloatArray, v: FloatArray, log_depth: FloatArray) -> FloatArray:
        """Grid coordinates ``(3, ...)``."""
        high = (log_depth - lowest) / _LEVEL_LOG + _BEYOND
        return np.stack([(v + 0.5) / _BLOCK - 0.5, (u + 0.5) / _BLOCK - 0.5, np.clip(high, 0.0, levels - 1.0)])

    cell = np.rint(place(uv[kept, 0], uv[kept, 1], level[kept])).astype(int)
    cell = np.clip(cell, 0, np.array(small)[:, None] - 1)
    index, r = np.ravel_multi_index(tuple(cell), small), residual[kept]
    radius = _NEAR_SHARE * width / _BLOCK
    v, u = np.mgrid[_STRIDE // 2 : height : _STRIDE, _STRIDE // 2 : width : _STRIDE]
    at = place(u, v, log_m[v, u])
    # Normalised so that one point has weight 1 at its own position.
    unit = (2.0 * np.pi) ** 1.5 * radius**2
    moments = []
    for weight in (np.ones(len(r)), r, r * r):
        grid = np.bincount(index, weight, math.prod(small)).reshape(small).astype(np.float32)
        smooth = ndimage.gaussian_filter(grid, (radius, radius, 1.0), mode="constant", truncate=2.5)
        moments.append(unit * ndimage.map_coordinates(smooth, at, order=1, mode="nearest"))
    n, sum_r, sum_rr = moments
    mean = sum_r / (n + _LINE_POINTS)
    about_mean = np.maximum(sum_rr - 2.0 * mean * sum_r + n * mean * mean, 0.0)
    unsupported = max(spread, alone_sigma) ** 2 + mean * mean
    variance = (about_mean + _LINE_POINTS * unsupported) / (n + _LINE_POINTS)
    sigma = np.maximum(np.sqrt(variance), _LEAST_SIGMA)
    return _enlarged(mean, log_m.shape), _enlarged(sigma, log_m.shape)


def _enlarged(small: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Nearest-neighbour upsampling by `_STRIDE`."""
    large = small.astype(np.float32).repeat(_STRIDE, axis=0).repeat(_STRIDE, axis=1)
    rest = [max(0, n - k) for n, k in zip(shape, large.shape, strict=True)]
    return np.pad(large, [(0, r) for r in rest], mode="edge")[: shape[0], : shape[1]]


def fit_to_points(depth: DepthMap, uv: FloatArray, map_m: FloatArray) -> NearFit | None:
    """`fit_near` at pixels ``(N, 2)`` of map points with depths ``(N,)``.

    Occluded points are outliers; the fit tolerates up to a third of them.
    """
    u, v = np.rint(uv).astype(int).T
    network_m = depth.depth_m[v, u].astype(np.float64)
    fit = fit_near(network_m, map_m)
    if fit is None:
        return None
    known = np.isfinite(network_m) & (network_m > 0)
    line = fit.offset + fit.slope * np.log(network_m[known])
    return replace(fit, uv=uv[known], level=line, residual=np.log(map_m[known]) - line)
