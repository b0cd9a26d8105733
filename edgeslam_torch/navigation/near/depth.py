"""Depth of the network brought to the map's metres, frame by frame, with a sigma that the fit has earned.

A network that was trained elsewhere is wrong by tens of percent as a whole and compresses the range of depths: what
is near is said to be farther than it is, which is the wrong side. The map's own points in the same picture tell both.
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
"""Prior of the slope around 1: rooms have shown .3 to .9 of network depth for map depth, that is 1.1 to 3 back."""
_LEAST_SIGMA = 0.03
_SLOPES = (0.6, 2.0)
_NEAR_SHARE = 0.06
"""Of the picture's width: 4 degrees of a Tello's, over which a network's error hardly changes."""
ALONE_SIGMA = 0.3
"""Of depth that rests on the network alone."""
_BIAS_SIGMA = 0.2
"""Of that in a picture whose points agree with what is usual, away from them: in eight flights 1.4 to 4 % of the pixels
told at .8 to 3 m were too far by more than twice as much."""
_LINE_POINTS = 3.0
"""Points that outweigh the line."""
_BLOCK, _STRIDE = 8, 4
"""Side of the grid's cells [px], and of the pixels that share a mean."""
_LEVEL_LOG, _BEYOND = 0.2, 3
"""Depth of the grid's cells, and cells before and behind all points that these say nothing of."""


_INDEPENDENT = 5.0
"""Errors of a picture's depth that have nothing to do with each other: all points of it together outweigh the usual
line no more than so many."""


@dataclass(frozen=True, slots=True)
class NearFit:
    """``log depth = offset + slope * log network depth``."""

    offset: float
    slope: float
    sigma_log: float
    """Robust spread of single points around it."""
    points: int
    uv: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    """``(P, 2)`` where in the picture the points are [px]; none: nothing is known of places."""
    level: FloatArray = field(default_factory=lambda: np.zeros(0))
    """``(P,)`` logarithm of the line's depth there."""
    residual: FloatArray = field(default_factory=lambda: np.zeros(0))
    """``(P,)`` logarithm of map depth over the line there."""
    bends: bool = False
    """Whether the line is not that of its points, and gives way to them at their depths."""

    @property
    def network_log(self) -> FloatArray:
        """``(P,)`` logarithm of network depth at the points."""
        return (self.level - self.offset) / self.slope

    @property
    def ratio_log(self) -> float:
        """Logarithm of map depth over network depth, in the median of the points."""
        return float(np.median(self.level + self.residual - self.network_log))

    def alone(self) -> "NearFit":
        """The line without its points: of another picture than theirs."""
        return NearFit(self.offset, self.slope, self.sigma_log, self.points)

    def through(self, points: "NearFit") -> "NearFit":
        """This line, which many pictures agree on, with the points of one picture: beyond their depths it stays, and
        the room behind a door is as far as usual, however wrong the network is about the wall."""
        level = self.offset + self.slope * points.network_log
        residual = points.level + points.residual - level
        spread = max(1.4826 * float(np.median(np.abs(residual - np.median(residual)))), _LEAST_SIGMA)
        return NearFit(self.offset, self.slope, spread, points.points, points.uv, level, residual, bends=True)

    def applied(self, depth: DepthMap) -> DepthMap:
        """Depth in metres, with the line's errors made up for near the points; unknown where the network's is.

        Its sigma is the spread of the points nearby, and the network's own far from all.
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
    """Robust line between logarithms of network depth and map depth at the same pixels, ``(N,)`` each.

    Huber weights, a prior of slope 1; None with fewer than `MIN_POINTS` points or no spread to speak of.
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
    """What points say of a line's error at any depths: a mean with Gaussian weights over `_LEVEL_LOG`, towards it.

    Points far from the others are hidden, or hide them, and count less (Huber).
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
    """What points ``(P, 2)`` with residuals ``(P,)`` say of a line's error at every pixel, and its standard deviation.

    Means with Gaussian weights over `_NEAR_SHARE` of the picture's width and over `_LEVEL_LOG` of the line's depth (a
    bilateral grid: Chen, Paris and Durand 2007), towards the line (error 0, standard deviation ``alone_sigma`` at
    least) with the weight of `_LINE_POINTS` points: the frame of a door tells nothing of the room that is seen through
    it, where a network that fits this room to 7 % was seen to be 40 % too near. Points more than three spreads farther
    than the line are hidden by what the network sees; those that are nearer are none that it hides.

    Args:
        uv: Where the points are [px].
        level: Logarithm of the line's depth there ``(P,)``.
        residual: Logarithm of map depth less that.
        spread: Robust standard deviation of the residuals.
        log_m: Logarithm of the line's depth at every pixel ``(H, W)``.
        alone_sigma: Of depth without points.

    Returns:
        Error and standard deviation ``(H, W)`` float32 each.
    """
    height, width = log_m.shape
    kept = residual < 3.0 * spread
    lowest = float(level[kept].min()) if kept.any() else 0.0
    levels = int((float(level[kept].max()) - lowest) / _LEVEL_LOG) + 1 + 2 * _BEYOND if kept.any() else 1
    small = (-(-height // _BLOCK), -(-width // _BLOCK), levels)

    def place(u: FloatArray, v: FloatArray, log_depth: FloatArray) -> FloatArray:
        """Coordinates ``(3, ...)`` in the grid."""
        high = (log_depth - lowest) / _LEVEL_LOG + _BEYOND
        return np.stack([(v + 0.5) / _BLOCK - 0.5, (u + 0.5) / _BLOCK - 0.5, np.clip(high, 0.0, levels - 1.0)])

    cell = np.rint(place(uv[kept, 0], uv[kept, 1], level[kept])).astype(int)
    cell = np.clip(cell, 0, np.array(small)[:, None] - 1)
    index, r = np.ravel_multi_index(tuple(cell), small), residual[kept]
    radius = _NEAR_SHARE * width / _BLOCK
    v, u = np.mgrid[_STRIDE // 2 : height : _STRIDE, _STRIDE // 2 : width : _STRIDE]
    at = place(u, v, log_m[v, u])
    # The weight of one point in its own place is 1; without a point counts are integers.
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
    """Each pixel as the one nearest to it that was asked about."""
    large = small.astype(np.float32).repeat(_STRIDE, axis=0).repeat(_STRIDE, axis=1)
    rest = [max(0, n - k) for n, k in zip(shape, large.shape, strict=True)]
    return np.pad(large, [(0, r) for r in rest], mode="edge")[: shape[0], : shape[1]]


def fit_to_points(depth: DepthMap, uv: FloatArray, map_m: FloatArray) -> NearFit | None:
    """`fit_near` at the pixels ``(N, 2)`` where points of the map are seen, at depths ``(N,)``.

    Points that a nearer one hides are outliers of the fit, of which it bears a third.
    """
    u, v = np.rint(uv).astype(int).T
    network_m = depth.depth_m[v, u].astype(np.float64)
    fit = fit_near(network_m, map_m)
    if fit is None:
        return None
    known = np.isfinite(network_m) & (network_m > 0)
    line = fit.offset + fit.slope * np.log(network_m[known])
    return replace(fit, uv=uv[known], level=line, residual=np.log(map_m[known]) - line)
