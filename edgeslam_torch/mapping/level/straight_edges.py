r"""The vertical from straight edges: vertical edges are parallel to it, horizontal ones perpendicular.

The direction of a straight segment lies on a great circle known to a fraction of a degree; the depths of its edges give
its position on the circle to some degrees. All keyframes vote in the map's world. The direction that most segments are
parallel or perpendicular to is one of the three axes of a room; which of them is vertical follows from how people and
drones hold and rotate cameras (about the vertical), and from the share of horizontal segments: floors, desks and
objects on them. If these disagree, the vertical is unknown.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.level import Up
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.mapping.edges.edge_map import NEARLY, EdgePoints
from edgeslam_torch.types import FloatArray, IntArray

_MOST_KEYFRAMES, _MOST_SEGMENTS = 20, 800
"""Maximum number of keyframes, spread evenly over the run, and of segments, the longest: a quarter of a second."""
_LEAST_KEYFRAMES, _LEAST_SEGMENTS = 10, 40
_MIN_LENGTH = 0.05
"""Minimum length of a segment relative to the image width."""
_MIN_POINTS = 6
"""Minimum number of edges with depth for a segment's direction in space."""

_CIRCLE_RAD = math.radians(1.0)
"""Standard deviation of a segment's great circle, including how parallel buildings are."""
_ALONG_RAD = math.radians(4.0)
"""Minimum standard deviation along the great circle."""
_ACROSS_RAD = math.radians(1.5)
"""Standard deviation of a horizontal segment's inclination."""
_BLURS = (4.0, 3.0, 2.0, 1.5, *[1.0] * 8)
"""Factors on these sigmas in the steps of a refinement, coarse to fine for a wide basin of convergence."""
_CANDIDATES = 1500
_MERGED_COS = math.cos(math.radians(12.0))
"""Candidates at smaller angles are merged."""
_DISTINCT_COS = math.cos(math.radians(30.0))
"""Candidates at larger angles are different axes."""

_ROLL_RAD, _PITCH_RAD, _MEAN_PITCH_RAD = math.radians(15.0), math.radians(30.0), math.radians(-10.0)
"""Prior of a camera's attitude: standard deviations of roll and pitch, and mean pitch (cameras look slightly down)."""
_ANY_WAY = 0.1
"""Share of cameras in any other attitude, such as rotated phones."""
_ODDS = 6.0
"""Minimum likelihood ratio of the best candidate to every other."""
_LEAST = 0.025
"""Minimum share of the segments' length that supports it."""
_FAR_FROM_UP = math.cos(math.radians(65.0))
"""Maximum angle from the images' mean up axis; edges alone cannot distinguish a rotated camera from a tilted one."""

_BUILT_RAD = math.radians(1.5)
"""Deviation of buildings from level, and accuracy of map directions."""
_DEPTH_RAD = math.radians(2.0)
"""Common error of directions derived from depths."""
_PIVOT = 0.015
"""Distance from the camera of the point about which a map takes it to turn, relative to the depth: that of
`noise.MAP_PIVOT_M` in a room, in maps without metres. Depths and their common tilt are as wrong as this is large beside
the camera's motion."""
_CIRCLES_TELL = 5.0
"""Weight of segments along the vertical relative to those across it."""
_BLOCKS = 4
"""Number of parts of the run for the jackknife."""
_MAX_SIGMA = math.radians(4.0)
"""Maximum standard deviation of a usable result."""


@dataclass(frozen=True, slots=True)
class Segments:
    """Straight segments in the map's world."""

    normal: FloatArray
    """``(S, 3)`` normals of their great circles."""
    direction: FloatArray
    """``(S, 3)`` unit directions."""
    sigma_rad: FloatArray
    """``(S,)`` standard deviation of the direction along the great circle."""
    length: FloatArray
    """``(S,)`` length in the image [focal lengths]."""
    keyframe: IntArray
    """``(S,)`` number of the keyframe."""

    def take(self, which: IntArray) -> "Segments":
        """Selected segments."""
        return Segments(
            self.normal[which], self.direction[which], self.sigma_rad[which], self.length[which], self.keyframe[which]
        )


def up_by_edges(keyframes: Sequence[Keyframe], hosts: Sequence[EdgePoints], camera: Camera) -> Up | None:
    """Vertical of the map; None if edges do not determine it.

    Args:
        keyframes: Of one submap, oldest first.
        hosts: Measured edges.
        camera: Intrinsics; the uncertainty of the focal length contributes to sigma.
    """
    points = {host.keyframe_id: host for host in hosts}
    voting = [k for k in keyframes if k.id in points and k.grey is not None]
    voting = [voting[i] for i in np.unique(np.linspace(0, len(voting) - 1, _MOST_KEYFRAMES).astype(int)) if voting]
    if len(voting) < _LEAST_KEYFRAMES:
        return None
    detector = cv2.createLineSegmentDetector(0)
    parts = [segments_of(k, points[k.id], camera, detector, number) for number, k in enumerate(voting)]
    depth = float(np.median(np.concatenate([points[k.id].p_c[:, 2] for k in voting])))
    return vertical(_joined(parts), np.stack([se3.inverse(k.T_c_w) for k in voting]), depth, camera.focal_sigma)


def vertical(segments: Segments, T_w_c: FloatArray, depth: float, focal_sigma: float = 0.0) -> Up | None:
    """Vertical from segments; None if they do not determine it.

    Args:
        segments: Of all keyframes.
        T_w_c: ``(K, 4, 4)`` the keyframes' poses, in temporal order.
        depth: Median depth of the edges [map units].
        focal_sigma: Relative standard deviation of the focal length.
    """
    R_w_c = T_w_c[:, :3, :3]
    longest = np.sort(np.argsort(-segments.length, kind="stable")[:_MOST_SEGMENTS])
    segments = segments.take(longest)
    if len(longest) < _LEAST_SEGMENTS:
        return None
    image_up = -R_w_c[:, :, 1].mean(axis=0)
    tried = _directions(segments)
    support = _support(tried, segments)
    candidates = [_refined(v, segments) for v in _peaks(tried, support.along + support.square)]
    candidates = [v if v @ image_up >= 0 else -v for v in candidates]
    likely = np.array([_likelihood(v, segments, R_w_c) for v in candidates])
    axes = np.stack(candidates)
    same = np.abs(axes @ axes[int(likely.argmax())]) >= _DISTINCT_COS
    rivals = likely[~same]
    support = _support(axes, segments)
    best = axes[int(np.where(same, support.along + support.square, -1.0).argmax())]
    share = _support(best[None], segments)
    upward = float(best @ image_up) / max(float(np.linalg.norm(image_up)), 1e-6)
    explained = float(share.along[0] + share.square[0])
    if explained < _LEAST or likely.max() < _ODDS * max(rivals, default=0.0) or upward < _FAR_FROM_UP:
        return None
    by_depth = float(share.across[0] / (share.across[0] + _CIRCLES_TELL * share.along[0]))
    depth_rad = math.hypot(_DEPTH_RAD, _PIVOT * depth * _turning(T_w_c))
    sigma = math.hypot(_BUILT_RAD, depth_rad * by_depth, _jackknife(best, segments), 0.5 * focal_sigma)
    return Up(best, sigma, "edges") if sigma < _MAX_SIGMA else None


def _turning(T_w_c: FloatArray) -> float:
    """Rotation of a camera relative to its translation [rad / map unit], each root mean square about the mean."""
    off = T_w_c[:, :3] - T_w_c[:, :3].mean(axis=0)
    turned, moved = np.sum(off[:, :, :3] ** 2) / 2.0, np.sum(off[:, :, 3] ** 2)
    return math.sqrt(float(turned) / max(float(moved), 1e-12))


def segments_of(
    keyframe: Keyframe, points: EdgePoints, camera: Camera, detector: cv2.LineSegmentDetector, number: int
) -> Segments:
    """Segments of one keyframe with depth from its edges; a line's inverse depth is affine along its image."""
    assert keyframe.grey is not None
    half = cv2.resize(keyframe.grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    found = detector.detect(half)[0]
    ends = np.zeros((0, 4)) if found is None else (found.reshape(-1, 4).astype(np.float64) + 0.5) * 2.0 - 0.5
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    ends, length = ends[length > _MIN_LENGTH * camera.width], length[length > _MIN_LENGTH * camera.width]
    label = np.full(keyframe.grey.shape, -1, np.int32)
    for i, (u0, v0, u1, v1) in enumerate(np.rint(ends).astype(int).tolist()):
        cv2.line(label, (u0, v0), (u1, v1), i, 3)
    z = points.p_c[:, 2]
    column, row = np.rint(points.uv).astype(int).T
    of = label[row.clip(0, camera.height - 1), column.clip(0, camera.width - 1)]
    used = (of >= 0) & (points.sigma < NEARLY * z) & (points.sigma > 0)
    of, inverse, sigma = of[used], 1.0 / z[used], points.sigma[used] / z[used] ** 2
    way = ends[:, 2:] - ends[:, :2]
    t = np.sum((points.uv[used] - ends[of, :2]) * way[of], axis=1) / length[of] ** 2
    near, far, slope_sigma = _affine(of, t, inverse, sigma, len(ends))
    good = (np.bincount(of, minlength=len(ends)) >= _MIN_POINTS) & (near > 0) & (far > 0) & np.isfinite(slope_sigma)
    ends, length, near, far = ends[good], length[good], near[good], far[good]
    one = np.ones(len(ends))
    ray0, ray1 = camera.back_project(ends[:, :2], one), camera.back_project(ends[:, 2:], one)
    a, b = ray0 / near[:, None], ray1 / far[:, None]
    direction, middle = _unit(b - a), 0.5 * (a + b)
    lever = np.linalg.norm(np.cross(direction, middle), axis=1) / np.linalg.norm(b - a, axis=1)
    along = lever * slope_sigma[good] * 2.0 / (near + far)
    R_w_c = keyframe.T_c_w[:3, :3].T
    normal = _unit(np.cross(ray0, ray1))
    numbers = np.full(len(ends), number)
    return Segments(normal @ R_w_c.T, direction @ R_w_c.T, along, length / camera.fx, numbers)


def _affine(
    of: IntArray, t: FloatArray, y: FloatArray, sigma: FloatArray, count: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Values at ``t`` 0 and 1 ``(count,)`` of straight lines through grouped points, and sigma of their slopes."""
    weight = 1.0 / sigma**2
    for _ in range(3):
        one, s, ss, sy, ssy = (
            np.bincount(of, weight * x, minlength=count) for x in (np.ones(len(t)), t, t * t, y, t * y)
        )
        determinant = np.maximum(one * ss - s * s, 1e-12 * np.maximum(one * ss, 1e-30))
        start, slope = (ss * sy - s * ssy) / determinant, (one * ssy - s * sy) / determinant
        residual = np.abs(y - start[of] - slope[of] * t) / sigma
        weight = 1.0 / (sigma * np.maximum(1.0, residual / 1.5)) ** 2
    return start, start + slope, np.sqrt(one / determinant)


def _unit(v: FloatArray) -> FloatArray:
    return np.asarray(v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-12))


def _joined(parts: Sequence[Segments]) -> Segments:
    names = ("normal", "direction", "sigma_rad", "length", "keyframe")
    return Segments(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _directions(segments: Segments) -> FloatArray:
    """Candidate directions ``(D, 3)``: those of segments, and cross products of pairs."""
    rng = np.random.default_rng(0)
    i, j = rng.integers(len(segments.length), size=(2, _CANDIDATES))
    d = segments.direction
    crossed = np.cross(d[i], d[j])
    return np.concatenate([d, _unit(crossed[np.linalg.norm(crossed, axis=1) > 0.3])])


def _weights(v: FloatArray, segments: Segments, blur: float = 1.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weights ``(D, S)`` of segments along and across directions ``(D, 3)``, and sigma of the latter [rad]."""
    sigma = np.hypot(np.minimum(segments.sigma_rad, 1.0), _ALONG_RAD)
    beside = v @ np.cross(segments.normal, segments.direction).T
    along = np.exp(-0.5 * ((v @ segments.normal.T / (blur * _CIRCLE_RAD)) ** 2 + (beside / sigma) ** 2))
    level = np.hypot(np.abs(beside) * sigma, blur * _ACROSS_RAD)
    return along, np.exp(-0.5 * (v @ segments.direction.T / level) ** 2), level


@dataclass(frozen=True, slots=True)
class _Support:
    """Shares of the segments' length, ``(D,)`` each."""

    along: FloatArray
    across: FloatArray
    square: FloatArray
    """Of those across, the part with perpendicular partners: one direction alone has a whole circle across it."""


def _support(v: FloatArray, segments: Segments) -> _Support:
    """Support for directions ``(D, 3)`` by segments along and across them."""
    weight, d, shares = segments.length / segments.length.sum(), segments.direction, []
    outer = (d[:, :, None] * d[:, None, :]).reshape(-1, 9)
    for part in np.array_split(v, max(1, len(v) // 256)):
        along, across, level = _weights(part, segments)
        across = across * _ACROSS_RAD / level * weight
        square = np.linalg.eigvalsh((across @ outer).reshape(-1, 3, 3))[:, 1]
        shares.append((along @ weight, across.sum(axis=1), square))
    return _Support(*(np.concatenate(share) for share in zip(*shares, strict=True)))


def _peaks(v: FloatArray, support: FloatArray, most: int = 8) -> list[FloatArray]:
    left = support.copy()
    peaks: list[FloatArray] = []
    while len(peaks) < most and left.max() > 0:
        peaks.append(v[int(left.argmax())])
        left[np.abs(v @ peaks[-1]) > _MERGED_COS] = 0.0
    return peaks


def _refined(v: FloatArray, segments: Segments) -> FloatArray:
    """Refine a direction by the segments along and across it."""
    for blur in _BLURS:
        along, across, level = (x[0] for x in _weights(v[None], segments, blur))
        n, d = segments.normal, segments.direction
        information = (n * (segments.length * along / (blur * _CIRCLE_RAD) ** 2)[:, None]).T @ n
        information += (d * (segments.length * across / level**2)[:, None]).T @ d
        better = np.linalg.eigh(information)[1][:, 0]
        v = better if better @ v >= 0 else -better
    return v


def _likelihood(v: FloatArray, segments: Segments, R_w_c: FloatArray) -> float:
    """Unnormalised likelihood that a direction is the vertical."""
    turns = np.cross(R_w_c[:-1, :, 2], R_w_c[1:, :, 2]) + np.cross(R_w_c[:-1, :, 0], R_w_c[1:, :, 0])
    turns = turns + np.cross(R_w_c[:-1, :, 1], R_w_c[1:, :, 1])  # approximately twice the rotation vectors
    about = float(np.mean((turns @ v) ** 2) / max(float(np.mean(turns**2)), 1e-12))
    roll = np.arcsin(np.clip(R_w_c[:, :, 0] @ v, -1.0, 1.0))
    pitch = np.arcsin(np.clip(R_w_c[:, :, 2] @ v, -1.0, 1.0))
    likelihood = np.exp(-0.5 * ((roll / _ROLL_RAD) ** 2 + ((pitch - _MEAN_PITCH_RAD) / _PITCH_RAD) ** 2))
    return (_ANY_WAY + float(likelihood.mean())) * (about + 0.01) * float(_support(v[None], segments).across[0])


def _jackknife(best: FloatArray, segments: Segments) -> float:
    """Standard deviation [rad] of a direction by the jackknife over parts of the run."""
    count = float(segments.keyframe.max()) + 1.0
    block = np.minimum(segments.keyframe * _BLOCKS // count, _BLOCKS - 1)
    without = np.stack([_refined(best, segments.take(np.flatnonzero(block != b))) for b in range(_BLOCKS)])
    off = np.arccos(np.clip(without @ best, -1.0, 1.0))
    return math.sqrt((_BLOCKS - 1) / _BLOCKS * float(np.sum(off**2)))
