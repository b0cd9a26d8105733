"""Depth of edge pixels: the prior narrows a search along the epipolar lines of several keyframes.

The depth network (or the anchors around a pixel) says roughly how deep an edge is; where exactly is measured, as in
semi-dense mapping (Engel et al., ICCV 2013; Mur-Artal and Tardos, RSS 2015), by comparing the grey profile across
the edge with what the other keyframes show at each hypothesis. An edge that runs along the epipolar line cannot be
measured and is left out.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, IntArray

PROFILE_PX = np.array([-4.0, -2.0, 0.0, 2.0, 4.0])
"""Offsets along the edge normal at which grey values are compared."""
TRUNCATE = 30.0
"""Grey levels; a larger difference says no more (occlusion, highlight)."""
MAX_COST = 12.0
"""Mean grey difference of an accepted match; sensor noise and resampling give 3 to 6."""
MIN_ACROSS = 0.25
"""Sine of the angle between an edge and the epipolar line below which the edge slides along the line."""

_OFFSETS = PROFILE_PX.astype(np.float32)[:, None]
_CHUNK = 1024
"""Edges searched at a time: what a search makes then stays in the processor's cache."""


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
    hypotheses: int = 24,
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
        hypotheses: Samples of the coarse search.
    """
    E = len(uv)
    unknown = EdgeDepth(np.full(E, np.nan), np.full(E, np.nan))
    if E == 0 or not targets:
        return unknown
    reach = np.exp(2.5 * prior_sigma_log)
    low, high = 1.0 / (prior_depth * reach), reach / prior_depth
    step = (high - low) / (hypotheses - 1)
    grid = low[:, None] + step[:, None] * np.arange(hypotheses)
    rays = np.stack(
        [(uv[:, 0] - camera.cx) / camera.fx, (uv[:, 1] - camera.cy) / camera.fy, np.ones(E)], axis=1
    ).astype(np.float32)
    profile = _profile(host.grey, uv, normal)
    coarse = _cost(host, rays, normal, profile, grid, targets, camera)
    best = np.argmin(coarse, axis=1)
    rows = np.arange(E)
    lowest = coarse[rows, best]
    inner = (best > 0) & (best < hypotheses - 1)
    # Unique: no other valley nearly as deep.
    for column in range(-3, 4):
        coarse[rows, np.clip(best + column, 0, hypotheses - 1)] = np.inf
    rival = coarse.min(axis=1)
    ok = np.flatnonzero(inner & (lowest < MAX_COST) & (rival > 1.3 * lowest + 1.0))
    if len(ok) == 0:
        return unknown
    fine_step = 0.3 * step[ok]
    fine_grid = grid[ok, best[ok]][:, None] + fine_step[:, None] * np.arange(-4, 5)
    fine = _cost(host, rays[ok], normal[ok], profile[:, ok], fine_grid, targets, camera)
    k = np.clip(np.argmin(fine, axis=1), 1, fine.shape[1] - 2)
    r = np.arange(len(ok))
    a, b, c = fine[r, k - 1], fine[r, k], fine[r, k + 1]
    with np.errstate(divide="ignore", invalid="ignore"):  # infinite cost where no target sees the edge
        curvature = a - 2.0 * b + c
        offset = np.clip(0.5 * (a - c) / curvature, -1.0, 1.0)
    rho = fine_grid[r, k] + offset * fine_step
    sharp = (curvature > 1e-3) & np.isfinite(offset) & (b < MAX_COST)
    inverse_depth, sigma = np.full(E, np.nan), np.full(E, np.nan)
    inverse_depth[ok[sharp]] = rho[sharp]
    sigma[ok[sharp]] = _sigma(host, rays[ok[sharp]], normal[ok[sharp]], rho[sharp], targets, camera)
    return EdgeDepth(inverse_depth, sigma)


def _profile(grey: NDArray[np.uint8], uv: FloatArray, normal: FloatArray) -> NDArray[np.uint8]:
    """Grey values ``(P, E)`` across each edge."""
    return np.concatenate(
        [
            _across(grey, uv[part, :1].astype(np.float32), uv[part, 1:].astype(np.float32), normal[part])[:, :, 0]
            for part in _parts(len(uv))
        ],
        axis=1,
    )


def _parts(count: int) -> Iterator[slice]:
    return (slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK))


def _across(grey: NDArray[np.uint8], x: FloatArray, y: FloatArray, normal: FloatArray) -> NDArray[np.uint8]:
    """Grey values ``(P, M, D)`` on the profiles through pixels ``(M, D)`` along normals ``(M, 2)``."""
    shift = _OFFSETS * normal.T.astype(np.float32)[:, None]
    maps = [pixel + offset[:, :, None] for pixel, offset in zip((x, y), shift, strict=True)]
    # Profile first, so that every sum over it runs over contiguous memory.
    flat = [m.reshape(len(x), -1) for m in maps]  # any shape will do; long rows cost less than short ones
    seen = cv2.remap(grey, flat[0], flat[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return seen.reshape(maps[0].shape)


def _relative(host: StereoView, target: StereoView) -> tuple[FloatArray, FloatArray]:
    R = target.T_c_w[:3, :3] @ host.T_c_w[:3, :3].T
    return R.astype(np.float32), (target.T_c_w[:3, 3] - R @ host.T_c_w[:3, 3]).astype(np.float32)


def _cost(
    host: StereoView,
    rays: FloatArray,
    normal: FloatArray,
    profile: NDArray[np.uint8],
    inverse_depth: FloatArray,
    targets: list[StereoView],
    camera: Camera,
) -> FloatArray:
    """Mean truncated grey difference ``(E, D)`` over the targets that can see and measure each edge."""
    E, D = inverse_depth.shape
    rho = inverse_depth.astype(np.float32)
    total = np.zeros((E, D), np.float32)
    weight = np.full(E, 1e-6, np.float32)
    for target in targets:
        R, t = _relative(host, target)
        a = rays @ R.T
        turned = normal @ R[:2, :2].T
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-6)
        seen, share = _measurable(a, rho, t, turned, camera)
        # In pixels: the numerators of x and y.
        a = a * np.array([camera.fx, camera.fy, 1.0], np.float32)
        step = t * np.array([camera.fx, camera.fy, 1.0], np.float32)
        for part in _parts(len(seen)):
            rows, across = seen[part], share[part]
            ray, inverse = a[rows], rho[rows]
            z, x, y = (inverse * step[k] for k in (2, 0, 1))
            z += ray[:, 2:]
            x += ray[:, 0:1]
            y += ray[:, 1:2]
            x /= z
            y /= z
            x += np.float32(camera.cx)
            y += np.float32(camera.cy)
            grey = _across(target.grey, x, y, turned[rows])
            total[rows] += across[:, None] * _difference(grey, profile[:, rows])
            weight[rows] += across
    cost = total / weight[:, None]
    cost[weight < 0.5] = np.inf  # fewer than about two useful targets
    return cost


def _difference(seen: NDArray[np.uint8], expected: NDArray[np.uint8]) -> FloatArray:
    """Mean truncated difference ``(M, D)`` of profiles ``(P, M, D)`` from the host's ``(P, M)``, in grey levels.

    Half of a common brightness change is taken out: exposure drifts, but brightness also tells edges apart. All of it
    in 16-bit integers, which hold tenths of grey levels (``2 P``) exactly and are four times as fast as floats.
    """
    tenths = 2 * len(seen)
    difference = seen.astype(np.int16)
    difference -= expected.astype(np.int16)[:, :, None]
    common = difference.sum(axis=0, dtype=np.int16)
    difference *= np.int16(tenths)
    difference -= common
    np.abs(difference, out=difference)
    np.minimum(difference, np.full_like(difference[0], tenths * TRUNCATE), out=difference)
    return difference.sum(axis=0, dtype=np.int16) * np.float32(1.0 / (tenths * len(seen)))


def _measurable(
    rays: FloatArray, rho: FloatArray, t: FloatArray, normal: FloatArray, camera: Camera
) -> tuple[IntArray, FloatArray]:
    """Edges whose whole search segment lies in the target, and the share of it that crosses the edge."""
    ends = []
    inside = np.ones(len(rays), dtype=bool)
    for column in (0, -1):
        z = rays[:, 2] + rho[:, column] * t[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = camera.fx * (rays[:, 0] + rho[:, column] * t[0]) / z + camera.cx
            y = camera.fy * (rays[:, 1] + rho[:, column] * t[1]) / z + camera.cy
        inside &= (z > 0) & (x > 5) & (x < camera.width - 6) & (y > 5) & (y < camera.height - 6)
        ends.append((x, y))
    (x0, y0), (x1, y1) = ends
    du, dv = x1 - x0, y1 - y0
    across = np.abs(du * normal[:, 0] + dv * normal[:, 1]) / np.maximum(np.hypot(du, dv), 1e-6)
    rows = np.flatnonzero(inside & (across > MIN_ACROSS))
    return rows, across[rows].astype(np.float32)


def _sigma(
    host: StereoView,
    rays: FloatArray,
    normal: FloatArray,
    rho: FloatArray,
    targets: list[StereoView],
    camera: Camera,
) -> FloatArray:
    """Inverse-depth sigma of half a pixel across the edge, all useful targets together."""
    information = np.full(len(rho), 1e-12)
    for target in targets:
        R, t = _relative(host, target)
        a = rays @ R.T
        z = a[:, 2] + rho * t[2]
        # Derivative of the pixel by inverse depth.
        du = camera.fx * (t[0] * a[:, 2] - a[:, 0] * t[2]) / z**2
        dv = camera.fy * (t[1] * a[:, 2] - a[:, 1] * t[2]) / z**2
        turned = normal @ R[:2, :2].T
        turned /= np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-6)
        information += (du * turned[:, 0] + dv * turned[:, 1]) ** 2 / 0.5**2
    return 1.0 / np.sqrt(information)
