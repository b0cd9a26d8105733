"""Depth of edge pixels by a search along the epipolar lines of several keyframes, within a depth prior.

The depth network (or the anchors around a pixel) says roughly how deep an edge is; where exactly is measured, as in
semi-dense mapping (Engel et al., ICCV 2013; Mur-Artal and Tardos, RSS 2015), by comparing the grey profile across
the edge with what the other keyframes show at each hypothesis: first coarsely, in smoothed images to the nearest
pixel, then around the only good hypothesis with interpolation. An edge that runs along the epipolar line cannot be
measured and is left out.

Edges are the last axis of every array, so that everything runs over contiguous memory.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray, IntArray

STEP_PX = 1.75
"""Mean spacing of the coarse search's hypotheses in the images: half the width of the cost valley of an edge whose
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

_CHUNK = 4096
"""Edges searched at a time, so that temporaries fit the processor's cache."""


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


@dataclass(frozen=True, slots=True)
class _Sampling:
    """Sampling of grey values across an edge."""

    offsets_px: FloatArray
    """``(P, 1, 1)`` along the edge's normal."""
    interpolation: int


_COARSE = _Sampling(np.array([-4.0, -1.5, 1.5, 4.0], np.float32)[:, None, None], cv2.INTER_NEAREST)
_FINE = _Sampling(np.array([-4.0, -2.0, 0.0, 2.0, 4.0], np.float32)[:, None, None], cv2.INTER_LINEAR)


@dataclass(frozen=True, slots=True)
class _Lines:
    """Epipolar lines of the host's edges in a target: inverse depth ``rho`` projects to ``ray + rho step``."""

    grey: NDArray[np.uint8]
    ray: FloatArray
    """``(3, E)`` homogeneous pixels of edges at infinity."""
    step: FloatArray
    """``(3,)``"""
    normal: FloatArray
    """``(2, E)`` unit normals of the edges."""

    def of(self, edges: IntArray) -> "_Lines":
        """The lines of selected edges."""
        return _Lines(self.grey, self.ray.take(edges, axis=1), self.step, self.normal.take(edges, axis=1))

    def pixels(self, rho: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pixels and depths ``(..., E)`` at inverse depths; the depths in units of the edge's own in the host."""
        x, y, z = (rho * along + start for along, start in zip(self.step, self.ray, strict=True))
        x /= z
        y /= z
        return x, y, z


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
    inverse_depth, sigma = np.full(len(uv), np.nan), np.full(len(uv), np.nan)
    if len(uv) == 0 or not targets:
        return EdgeDepth(inverse_depth, sigma)
    pixel, across = uv.T.astype(np.float32), normal.T.astype(np.float32)
    reach = np.exp(2.5 * prior_sigma_log)
    low, high = ((1.0 / (prior_depth * reach)).astype(np.float32), (reach / prior_depth).astype(np.float32))
    with np.errstate(divide="ignore", invalid="ignore"):  # points beside or behind a target get infinite cost
        lines = [_epipolar_lines(host, target, pixel, across, camera) for target in targets]
        edges, rho, step = _coarse_search(_smooth(host.grey), pixel, across, lines, low, high, camera, most)
        for part in _parts(len(edges)):
            some = edges[part]
            profile = _profile(host.grey, pixel.take(some, axis=1), across.take(some, axis=1), _FINE)
            near = [line.of(some) for line in lines]
            inverse_depth[some] = _fine_search(profile, near, rho[part], np.float32(FINE_STEP) * step[part], camera)
        measured = np.flatnonzero(np.isfinite(inverse_depth))
        sigma[measured] = _sigma([line.of(measured) for line in lines], inverse_depth[measured])
    return EdgeDepth(inverse_depth, sigma)


def _smooth(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Smoothed image, insensitive to rounding to pixels."""
    return cv2.blur(grey, (3, 3)).astype(np.uint8, copy=False)


def _epipolar_lines(host: StereoView, target: StereoView, uv: FloatArray, normal: FloatArray, camera: Camera) -> _Lines:
    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    R = target.T_c_w[:3, :3] @ host.T_c_w[:3, :3].T
    t = target.T_c_w[:3, 3] - R @ host.T_c_w[:3, 3]
    H = (K @ R @ np.linalg.inv(K)).astype(np.float32)
    turned = R[:2, :2].astype(np.float32) @ normal
    turned /= np.maximum(np.hypot(*turned), np.float32(1e-6))
    return _Lines(target.grey, H[:, :2] @ uv + H[:, 2:], (K @ t).astype(np.float32), turned)


def _parts(count: int) -> Iterator[slice]:
    return (slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK))


def _coarse_search(
    grey: NDArray[np.uint8],
    uv: FloatArray,
    normal: FloatArray,
    lines: list[_Lines],
    low: FloatArray,
    high: FloatArray,
    camera: Camera,
    most: int,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Edges ``(N,)`` with a unique minimum, the inverse depth of the minimum and the step of the search."""
    ends = [_measurable(line, low, high, camera) for line in lines]
    share, length = np.stack([s for s, _ in ends]), np.stack([n for _, n in ends])
    searched = np.flatnonzero(share.sum(axis=0) >= MIN_SHARE)
    if len(searched) == 0:
        return searched, low[:0], low[:0]
    count = int(np.clip(length[share > 0].mean() / STEP_PX + 1.5, HYPOTHESES[0], most))
    step = (high - low) / np.float32(count - 1)
    smooth = [_Lines(_smooth(line.grey), line.ray, line.step, line.normal) for line in lines]
    found = []
    for part in _parts(len(searched)):
        some = searched[part]
        profile = _profile(grey, uv.take(some, axis=1), normal.take(some, axis=1), _COARSE)
        near = [line.of(some) for line in smooth]
        cost = _cost(profile, near, share.take(some, axis=1), low[some], step[some], count, _COARSE)
        best = cost.argmin(axis=0)
        lowest = cost.min(axis=0)
        # Unique: no other valley nearly as deep.
        cost[np.abs(np.arange(count)[:, None] - best) <= VALLEY] = np.inf
        good = (best > 0) & (best < count - 1) & (lowest < MAX_COST) & (cost.min(axis=0) > UNIQUE * lowest + 1.0)
        found.append((some[good], low[some[good]] + best[good].astype(np.float32) * step[some[good]]))
    edges, rho = (np.concatenate(side) for side in zip(*found, strict=True))
    return edges, rho, step[edges]


def _fine_search(
    profile: NDArray[np.uint8], lines: list[_Lines], rho: FloatArray, step: FloatArray, camera: Camera
) -> FloatArray:
    """Inverse depth ``(E,)`` of the lowest cost around ``rho``, by a parabola; NaN where no cost is low enough."""
    count = 7
    first = rho - count // 2 * step
    share = np.stack([_measurable(line, first, first + (count - 1) * step, camera)[0] for line in lines])
    cost = _cost(profile, lines, share, first, step, count, _FINE)
    k, edge = np.clip(cost.argmin(axis=0), 1, count - 2), np.arange(len(rho))
    a, b, c = cost[k - 1, edge], cost[k, edge], cost[k + 1, edge]
    curvature = a - 2.0 * b + c
    offset = np.clip(0.5 * (a - c) / curvature, -1.0, 1.0)
    sharp = (curvature > 1e-3) & np.isfinite(offset) & (b < MAX_COST)
    refined: FloatArray = np.where(sharp, first + (k + offset) * step, np.nan)
    return refined


def _measurable(lines: _Lines, low: FloatArray, high: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray]:
    """Sine of the angle between each search segment and its edge ``(E,)``, and the segment's length [px].

    Zero where it does not cross, or where the segment is not wholly in the target.
    """
    (x0, y0, z0), (x1, y1, z1) = lines.pixels(low), lines.pixels(high)
    inside = np.minimum(z0, z1) > 0
    for p0, p1, size in ((x0, x1, camera.width), (y0, y1, camera.height)):
        inside &= (np.minimum(p0, p1) > 5) & (np.maximum(p0, p1) < size - 6)
    du, dv = x1 - x0, y1 - y0
    length = np.hypot(du, dv)
    share = np.abs(du * lines.normal[0] + dv * lines.normal[1]) / np.maximum(length, np.float32(1e-6))
    return np.where(inside & (share > MIN_ACROSS), share, np.float32(0.0)), length


def _cost(
    profile: NDArray[np.uint8],
    lines: list[_Lines],
    share: FloatArray,
    first: FloatArray,
    step: FloatArray,
    count: int,
    sampling: _Sampling,
) -> FloatArray:
    """Mean truncated grey difference ``(D, E)`` from profiles ``(P, E)`` over the targets, weighted by ``share``.

    The ``count`` hypotheses of an edge start at the inverse depth ``first`` with spacing ``step``.
    """
    total = np.zeros((count, len(first)), np.float32)
    hypothesis = np.arange(count, dtype=np.float32)[:, None]
    for line, across in zip(lines, share, strict=True):
        seen = np.flatnonzero(across)
        if len(seen) == 0:
            continue
        near = line.of(seen)
        x, y, _ = near.pixels(first[seen] + hypothesis * step[seen])
        difference = _difference(_across(near.grey, x, y, near.normal, sampling), profile.take(seen, axis=1))
        # Expanded to all edges with zero weight where unseen: a third of the time of indexed addition.
        total += across * difference.take(np.cumsum(across > 0) - 1, axis=1)
    weight = share.sum(axis=0)
    total[:, weight < MIN_SHARE] = np.inf
    total /= np.maximum(weight, MIN_SHARE)
    return total


def _profile(grey: NDArray[np.uint8], uv: FloatArray, normal: FloatArray, sampling: _Sampling) -> NDArray[np.uint8]:
    """The host's grey values ``(P, E)`` across edges ``(2, E)``."""
    exact = replace(sampling, interpolation=cv2.INTER_LINEAR)
    return _across(grey, uv[:1], uv[1:], normal, exact)[:, 0]


def _across(
    grey: NDArray[np.uint8], x: FloatArray, y: FloatArray, normal: FloatArray, sampling: _Sampling
) -> NDArray[np.uint8]:
    """Grey values ``(P, D, E)`` on the profiles through pixels ``(D, E)`` along normals ``(2, E)``."""
    u, v = (pixel + sampling.offsets_px * along for pixel, along in zip((x, y), normal, strict=True))
    flat_u, flat_v = (m.reshape(-1, m.shape[-1]) for m in (u, v))
    seen = cv2.remap(grey, flat_u, flat_v, sampling.interpolation, borderMode=cv2.BORDER_REPLICATE)
    return seen.reshape(u.shape)


def _difference(seen: NDArray[np.uint8], expected: NDArray[np.uint8]) -> FloatArray:
    """Mean truncated difference ``(D, E)`` of profiles ``(P, D, E)`` from the host's ``(P, E)``, in grey levels.

    Half of a common brightness change is removed: exposure drifts, but brightness also distinguishes edges. 16-bit
    integers represent the ``2 P``-th part of a grey level exactly and are four times as fast as floats.
    """
    parts = 2 * len(seen)
    difference = seen.astype(np.int16)
    difference -= expected.astype(np.int16)[:, None]
    common = difference.sum(axis=0, dtype=np.int16)
    difference *= np.int16(parts)
    difference -= common
    np.abs(difference, out=difference)
    most = np.full_like(difference[0], parts * TRUNCATE)  # the minimum with one number takes four times as long
    np.minimum(difference, most, out=difference)
    return difference.sum(axis=0, dtype=np.int16) * np.float32(1.0 / (parts * len(seen)))


def _sigma(lines: list[_Lines], rho: FloatArray) -> FloatArray:
    """Inverse-depth sigma for half a pixel across the edge, combining all targets."""
    information = np.full(len(rho), 1e-12)
    for line in lines:
        x, y, z = line.pixels(rho)
        # Derivative of the pixel by inverse depth.
        du, dv = (line.step[0] - x * line.step[2]) / z, (line.step[1] - y * line.step[2]) / z
        information += (du * line.normal[0] + dv * line.normal[1]) ** 2 / 0.5**2
    return 1.0 / np.sqrt(information)
