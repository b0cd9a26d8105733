"""Depth of the network brought to the map's metres, frame by frame, with a sigma that the fit has earned.

A network that was trained elsewhere is wrong by tens of percent as a whole and compresses the range of depths: what
is near is said to be farther than it is, which is the wrong side. The map's own points in the same picture tell both.
"""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.types import DepthMap, FloatArray

MIN_POINTS = 20
_ROUNDS = 6
_HUBER = 1.5
_SLOPE_SIGMA = 0.3
"""Prior of the slope around 1: rooms have shown .3 to .9 of network depth for map depth, that is 1.1 to 3 back."""
_LEAST_SIGMA = 0.03
_SLOPES = (0.6, 2.0)


@dataclass(frozen=True, slots=True)
class NearFit:
    """``log depth = offset + slope * log network depth``."""

    offset: float
    slope: float
    sigma_log: float
    """Robust spread of single points around it."""
    points: int

    def applied(self, depth: DepthMap) -> DepthMap:
        """Depth in metres with the fit's sigma; unknown where the network's is."""
        known = np.isfinite(depth.depth_m) & (depth.depth_m > 0)
        log_m = np.log(np.where(known, depth.depth_m, 1.0))
        metres = np.where(known, np.exp(self.offset + self.slope * log_m), np.nan).astype(np.float32)
        return DepthMap(metres, np.full(metres.shape, self.sigma_log, np.float32))


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


def fit_to_points(depth: DepthMap, K: FloatArray, T_w_c: FloatArray, points_w: FloatArray) -> NearFit | None:
    """`fit_near` at the pixels where points of the map ``(N, 3)`` [m] are seen from ``T_w_c`` ``(4, 4)``.

    Points that a nearer one hides are outliers of the fit, of which it bears a third.
    """
    p_c = (points_w - T_w_c[:3, 3]) @ T_w_c[:3, :3]
    p_c = p_c[p_c[:, 2] > 0.1]
    height, width = depth.depth_m.shape
    uv = np.rint((p_c[:, :2] / p_c[:, 2:]) * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]).astype(int)
    inside = ((uv >= 0) & (uv < [width, height])).all(1)
    u, v = uv[inside].T
    return fit_near(depth.depth_m[v, u].astype(np.float64), p_c[inside, 2])
