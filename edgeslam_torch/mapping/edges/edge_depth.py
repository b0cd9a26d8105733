"""Depth of edge pixels by a search along the epipolar lines of several keyframes, within a depth prior.

The depth network (or the anchors around a pixel) gives a rough depth of an edge; the exact one is measured, as in
semi-dense mapping (Engel et al., ICCV 2013; Mur-Artal and Tardos, RSS 2015), by comparing the grey profile across
the edge with what the other keyframes show at each hypothesis: first coarsely, in smoothed images to the nearest
pixel, then around the only good hypothesis with interpolation. An edge that runs along the epipolar line cannot be
measured and is left out.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray

STEP_PX = 1.75
"""Spacing of the coarse search's hypotheses, mean over the targets: half the width of the cost valley of an edge whose
profile is sampled 1.5 px to either side."""
HYPOTHESES = (8, 24)
"""Minimum and maximum number of hypotheses of the coarse search."""
VALLEY = 2
"""Half width of a cost valley in steps of the coarse search."""
UNIQUE = 1.2
"""Minimum ratio of every other valley's cost to the best one, plus a grey level: a standard deviation of the mean
absolute noise of four samples in five targets (0.76 / sqrt(20))."""
FINE_STEP = 0.3
"""Step of the fine search in steps of the coarse one; it takes three either way."""
TRUNCATE = 30.0
"""Truncation in grey levels, five to ten times the difference at a right match: beyond are occlusions and
highlights."""
MAX_COST = 12.0
"""Maximum mean grey difference of a match, twice that of right ones: sensor noise and resampling give 3 to 6."""
MIN_ACROSS = 0.25
"""Minimum sine of the angle between edge and epipolar line: below, half a pixel across the edge is two along the
line."""
MIN_SHARE = 0.5
"""Minimum sum of these sines over the targets."""

COARSE_PX, FINE_PX = (-4.0, -1.5, 1.5, 4.0), (-4.0, -2.0, 0.0, 2.0, 4.0)
"""Where the profile across an edge is sampled, along its normal."""


@dataclass(frozen=True, slots=True)
class StereoView:
    """A keyframe as edge stereo sees it."""

    grey: NDArray[np.uint8]
    """``(H, W)`` undistorted."""
    T_c_w: FloatArray


@dataclass(frozen=True, slots=True)
class EdgeDepth:
    """Measured inverse depths of edge pixels."""

    inverse_depth: FloatArray
    """``(E,)`` [1/map unit], NaN where not measured."""
    sigma: FloatArray
    """``(E,)`` its standard deviation."""


def measure_edge_depth(
    host: StereoView,
    uv: FloatArray,
    normal: FloatArray,
    prior_depth: FloatArray,
    prior_sigma_log: FloatArray,
    targets: list[StereoView],
    camera: Camera,
    most: int = HYPOTHESES[1],
) -> EdgeDepth:
    """Inverse depth of edge pixels ``(E, 2)`` of the host by multi-view search.

    Args:
        host: Keyframe that owns the pixels.
        uv: Edge pixels.
        normal: Unit gradients ``(E, 2)``.
        prior_depth: Expected z-depth ``(E,)`` [map units].
        prior_sigma_log: Its log standard deviation; the search spans two and a half either way.
        targets: Other keyframes with some baseline.
        camera: Intrinsics.
        most: Number of hypotheses of the coarse search.
    """
    if len(uv) == 0 or not targets:
        return EdgeDepth(np.full(len(uv), np.nan), np.full(len(uv), np.nan))
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    turned = np.stack([target.T_c_w[:3, :3] @ host.T_c_w[:3, :3].T for target in targets])
    moved = np.stack([target.T_c_w[:3, 3] - R @ host.T_c_w[:3, 3] for target, R in zip(targets, turned, strict=True)])
    reach = np.exp(2.5 * np.asarray(prior_sigma_log, dtype=np.float64))
    inverse_depth, sigma = _search(
        np.stack([_smooth(view.grey) for view in (host, *targets)]),
        np.stack([view.grey for view in (host, *targets)]),
        np.asarray(uv, dtype=np.float64),
        np.asarray(normal, dtype=np.float64),
        1.0 / (prior_depth * reach),
        reach / prior_depth,
        K @ turned @ np.linalg.inv(K),
        moved @ K.T,
        turned[:, :2, :2].copy(),
        most,
    )
    return EdgeDepth(inverse_depth, sigma)


def _smooth(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Smoothed image, insensitive to rounding to pixels."""
    return cv2.blur(grey, (3, 3)).astype(np.uint8, copy=False)


@compiled("u1[:,:,::1], u1[:,:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8[:,:,::1], f8[:,::1], f8[:,:,::1], i8")
def _search(
    smooth: NDArray[np.uint8],
    grey: NDArray[np.uint8],
    uv: FloatArray,
    normal: FloatArray,
    low: FloatArray,
    high: FloatArray,
    H: FloatArray,
    along: FloatArray,
    R: FloatArray,
    most: int,
) -> tuple[FloatArray, FloatArray]:
    """Inverse depths of edges and their sigmas ``(E,)``, NaN where not measured.

    Args:
        smooth: Smoothed images ``(1 + T, H, W)`` of host and targets.
        grey: The images themselves.
        uv: Pixels ``(E, 2)``.
        normal: Unit normals ``(E, 2)``.
        low: Minimum inverse depths ``(E,)``.
        high: Maximum inverse depths.
        H: Homographies of infinity ``(T, 3, 3)``: inverse depth ``rho`` projects to ``H uv + rho along``.
        along: ``(T, 3)``
        R: ``(T, 2, 2)``, turns normals to the targets.
        most: Maximum number of hypotheses.
    """
    targets = len(H)
    size = smooth.shape[2], smooth.shape[1]
    inverse_depth, sigma = np.full(len(uv), np.nan), np.full(len(uv), np.nan)
    ray, across, share = np.zeros((targets, 3)), np.zeros((targets, 2)), np.zeros(targets)
    coarse, fine, lowest = np.zeros(4), np.zeros(5), np.zeros(3)
    cost = np.zeros(max(most, HYPOTHESES[0]))
    for e in range(len(uv)):
        weight, length, crossing = 0.0, 0.0, 0
        for t in range(targets):
            for i in range(3):
                ray[t, i] = H[t, i, 0] * uv[e, 0] + H[t, i, 1] * uv[e, 1] + H[t, i, 2]
            for i in range(2):
                across[t, i] = R[t, i, 0] * normal[e, 0] + R[t, i, 1] * normal[e, 1]
            across[t] /= max(math.hypot(across[t, 0], across[t, 1]), 1e-6)
            share[t], pixels = _measurable(ray[t], along[t], across[t], low[e], high[e], size)
            if share[t] > 0.0:
                weight += share[t]
                length += pixels
                crossing += 1
        if weight < MIN_SHARE:
            continue
        count = min(max(int(length / crossing / STEP_PX + 1.5), HYPOTHESES[0]), most)
        step = (high[e] - low[e]) / (count - 1)
        for i in range(4):
            px = COARSE_PX[i]
            coarse[i] = _interpolated(smooth[0], uv[e, 0] + px * normal[e, 0], uv[e, 1] + px * normal[e, 1])
        cost[:count] = 0.0
        for t in range(targets):
            if share[t] > 0.0:
                _add_coarse(
                    smooth[1 + t], ray[t], along[t], across[t], share[t] / weight, coarse, low[e], step, cost[:count]
                )
        best = cost[:count].argmin()
        other = np.inf
        for k in range(count):
            if abs(k - best) > VALLEY:
                other = min(other, cost[k])
        if best == 0 or best == count - 1 or cost[best] >= MAX_COST or other <= UNIQUE * cost[best] + 1.0:
            continue
        # Descend from the best hypothesis in finer steps, then a parabola through the lowest three.
        rho = low[e] + best * step
        step *= FINE_STEP
        weight = 0.0
        for t in range(targets):
            share[t], _ = _measurable(ray[t], along[t], across[t], rho - 3 * step, rho + 3 * step, size)
            weight += share[t]
        if weight < MIN_SHARE:
            continue
        share /= weight
        for i in range(5):
            px = FINE_PX[i]
            fine[i] = _interpolated(grey[0], uv[e, 0] + px * normal[e, 0], uv[e, 1] + px * normal[e, 1])
        for k in range(3):  # one call and not three: the compiler copies what is called, which takes seconds
            lowest[k] = _fine_cost(grey, ray, along, across, share, fine, rho + (k - 1) * step)
        a, b, c = float(lowest[0]), float(lowest[1]), float(lowest[2])
        way = -1.0 if a < c else 1.0
        for _ in range(2):
            if b <= (a if way < 0.0 else c):
                break
            rho += way * step
            beyond = _fine_cost(grey, ray, along, across, share, fine, rho + way * step)
            a, b, c = (beyond, a, b) if way < 0.0 else (b, c, beyond)
        curvature = a - 2.0 * b + c
        if not (curvature > 1e-3 and b < MAX_COST):
            continue
        rho += min(max(0.5 * (a - c) / curvature, -1.0), 1.0) * step
        # Half a pixel of error across the edge in every target.
        information = 1e-12
        for t in range(targets):
            z = ray[t, 2] + rho * along[t, 2]
            x, y = (ray[t, 0] + rho * along[t, 0]) / z, (ray[t, 1] + rho * along[t, 1]) / z
            du, dv = (along[t, 0] - x * along[t, 2]) / z, (along[t, 1] - y * along[t, 2]) / z
            information += ((du * across[t, 0] + dv * across[t, 1]) / 0.5) ** 2
        inverse_depth[e], sigma[e] = rho, 1.0 / math.sqrt(information)
    return inverse_depth, sigma


@compiled()
def _add_coarse(
    smooth: NDArray[np.uint8],
    ray: FloatArray,
    along: FloatArray,
    across: FloatArray,
    weight: float,
    expected: FloatArray,
    low: float,
    step: float,
    cost: FloatArray,
) -> None:
    """Add a target's weighted differences from the profile ``expected`` at every hypothesis ``(D,)``."""
    x, y, z = ray[0] + low * along[0], ray[1] + low * along[1], ray[2] + low * along[2]
    dx, dy, dz = step * along[0], step * along[1], step * along[2]
    p, q, r, s = COARSE_PX
    pu, qu, ru, su = 0.5 + p * across[0], 0.5 + q * across[0], 0.5 + r * across[0], 0.5 + s * across[0]
    pv, qv, rv, sv = 0.5 + p * across[1], 0.5 + q * across[1], 0.5 + r * across[1], 0.5 + s * across[1]
    for k in range(len(cost)):
        nearer = 1.0 / z
        u, v = x * nearer, y * nearer
        # Unsigned indices, since signed ones may count from the end.
        a = smooth[np.uint64(int(v + pv)), np.uint64(int(u + pu))] - expected[0]
        b = smooth[np.uint64(int(v + qv)), np.uint64(int(u + qu))] - expected[1]
        c = smooth[np.uint64(int(v + rv)), np.uint64(int(u + ru))] - expected[2]
        d = smooth[np.uint64(int(v + sv)), np.uint64(int(u + su))] - expected[3]
        common = 0.125 * (a + b + c + d)
        near = min(abs(a - common), TRUNCATE) + min(abs(b - common), TRUNCATE)
        cost[k] += 0.25 * weight * (near + min(abs(c - common), TRUNCATE) + min(abs(d - common), TRUNCATE))
        x, y, z = x + dx, y + dy, z + dz


@compiled()
def _measurable(
    ray: FloatArray, along: FloatArray, across: FloatArray, low: float, high: float, size: tuple[int, int]
) -> tuple[float, float]:
    """Sine of the angle between a search segment and its edge, and the segment's length [px].

    Zero where it does not cross, or where the segment is not wholly in the target.
    """
    z0, z1 = ray[2] + low * along[2], ray[2] + high * along[2]
    if not (z0 > 0.0 and z1 > 0.0):
        return 0.0, 0.0
    x0, x1 = (ray[0] + low * along[0]) / z0, (ray[0] + high * along[0]) / z1
    y0, y1 = (ray[1] + low * along[1]) / z0, (ray[1] + high * along[1]) / z1
    if not (min(x0, x1) > 5 and max(x0, x1) < size[0] - 6 and min(y0, y1) > 5 and max(y0, y1) < size[1] - 6):
        return 0.0, 0.0
    length = math.hypot(x1 - x0, y1 - y0)
    share = abs((x1 - x0) * across[0] + (y1 - y0) * across[1]) / max(length, 1e-6)
    return (share, length) if share > MIN_ACROSS else (0.0, 0.0)


@compiled()
def _fine_cost(
    grey: NDArray[np.uint8],
    ray: FloatArray,
    along: FloatArray,
    across: FloatArray,
    weight: FloatArray,
    expected: FloatArray,
    rho: float,
) -> float:
    """Weighted difference of all targets from the profile ``expected`` at an inverse depth."""
    cost = 0.0
    for t in range(len(ray)):
        if weight[t] > 0.0:
            nearer = 1.0 / (ray[t, 2] + rho * along[t, 2])
            x, y = (ray[t, 0] + rho * along[t, 0]) * nearer, (ray[t, 1] + rho * along[t, 1]) * nearer
            a = _interpolated(grey[1 + t], x + FINE_PX[0] * across[t, 0], y + FINE_PX[0] * across[t, 1]) - expected[0]
            b = _interpolated(grey[1 + t], x + FINE_PX[1] * across[t, 0], y + FINE_PX[1] * across[t, 1]) - expected[1]
            c = _interpolated(grey[1 + t], x + FINE_PX[2] * across[t, 0], y + FINE_PX[2] * across[t, 1]) - expected[2]
            d = _interpolated(grey[1 + t], x + FINE_PX[3] * across[t, 0], y + FINE_PX[3] * across[t, 1]) - expected[3]
            e = _interpolated(grey[1 + t], x + FINE_PX[4] * across[t, 0], y + FINE_PX[4] * across[t, 1]) - expected[4]
            common = 0.1 * (a + b + c + d + e)
            near = min(abs(a - common), TRUNCATE) + min(abs(b - common), TRUNCATE) + min(abs(c - common), TRUNCATE)
            near += min(abs(d - common), TRUNCATE) + min(abs(e - common), TRUNCATE)
            cost += 0.2 * weight[t] * near
    return cost


@compiled()
def _interpolated(grey: NDArray[np.uint8], u: float, v: float) -> float:
    """Grey value at a pixel; the border is replicated."""
    height, width = grey.shape
    u, v = min(max(u, 0.0), width - 1.001), min(max(v, 0.0), height - 1.001)
    x, y = np.uint64(int(u)), np.uint64(int(v))
    a, b = u - x, v - y
    right, below = x + np.uint64(1), y + np.uint64(1)
    here, under = float(grey[y, x]), float(grey[below, x])
    here += a * (grey[y, right] - here)
    under += a * (grey[below, right] - under)
    return here + b * (under - here)
