r"""Where up is by straight edges: verticals meet in one direction, and horizontals of all directions lie across it.

Each straight segment of a keyframe has a great circle on which its direction lies, known to a fraction of a degree, and
by its edges' depths a place on it, known to some degrees. All keyframes vote in the map's world. What most segments lie
along or across is up to the three axes of a room; which of them is up is decided by how people and drones hold and turn
cameras (about the vertical), and by how much is horizontal: floors, desks and what lies on them. If those do not agree,
up is not known.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.level import Up
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.mapping.edges.edge_map import NEARLY, EdgePoints
from edgeslam_torch.types import FloatArray, IntArray

_MOST_KEYFRAMES, _MOST_SEGMENTS = 40, 800
"""That vote, spread evenly over the run, the longest: bounds the time to half a second."""
_LEAST_KEYFRAMES, _LEAST_SEGMENTS = 10, 40
_MIN_LENGTH = 0.05
"""Shortest segment, share of the picture's width."""
_MIN_POINTS = 6
"""Edges with depth that tell a segment's direction in space."""

_CIRCLE_RAD = math.radians(1.0)
"""Standard deviation of a segment's great circle, and of how parallel things are built."""
_ALONG_RAD = math.radians(4.0)
"""The same along the great circle, at best."""
_ACROSS_RAD = math.radians(1.5)
"""Standard deviation of a horizontal segment's inclination."""
_BLURS = (4.0, 3.0, 2.0, 1.5, *[1.0] * 8)
"""Factors on these in the steps of a refinement, which begins far from the maximum."""
_CANDIDATES = 1500
_APART = math.cos(math.radians(12.0))
"""Candidates nearer to one another are one."""
_ELSEWHERE = math.cos(math.radians(30.0))
"""And further apart, different axes."""

_ROLL_RAD, _PITCH_RAD, _USUAL_PITCH_RAD = math.radians(15.0), math.radians(30.0), math.radians(-10.0)
"""How cameras are held: level to the sides, looking down rather than up."""
_ANY_WAY = 0.1
"""Share of cameras that are held in any other way, such as turned phones."""
_ODDS = 6.0
"""By which the best candidate must be more likely than every other."""
_LEAST = 0.025
"""Share of the segments' length that must tell it."""
_FAR_FROM_UP = math.cos(math.radians(65.0))
"""Larger angles of the images' mean up are not believed: a turned camera, which edges alone do not tell from a tilt."""

_BUILT_RAD = math.radians(1.5)
"""What is built and put up is level to this, and maps are true to it."""
_DEPTH_RAD = math.radians(2.0)
"""Common error of directions that rest on depths."""
_CIRCLES_TELL = 5.0
"""Great circles along the vertical tell so much more of it than directions across it."""
_BLOCKS = 4
"""Parts of the run that are left out in turn."""
_MAX_SIGMA = math.radians(4.0)
"""Less sure than this is not known."""


@dataclass(frozen=True, slots=True)
class Segments:
    """Straight segments in the map's world."""

    normal: FloatArray
    """``(S, 3)`` of their great circles."""
    direction: FloatArray
    """``(S, 3)`` unit."""
    sigma_rad: FloatArray
    """``(S,)`` of the direction along the great circle."""
    length: FloatArray
    """``(S,)`` in the picture, in focal lengths."""
    keyframe: IntArray
    """``(S,)`` number of the keyframe."""

    def take(self, which: IntArray) -> "Segments":
        """Some of them."""
        return Segments(
            self.normal[which], self.direction[which], self.sigma_rad[which], self.length[which], self.keyframe[which]
        )


def up_by_edges(keyframes: Sequence[Keyframe], hosts: Sequence[EdgePoints], camera: Camera) -> Up | None:
    """Where up is in the map; None where edges do not tell.

    Args:
        keyframes: Of one piece of map, oldest first.
        hosts: Measured edges.
        camera: That took them; what its focal length may be off goes into sigma.
    """
    points = {host.keyframe_id: host for host in hosts}
    voting = [k for k in keyframes if k.id in points and k.grey is not None]
    voting = [voting[i] for i in np.unique(np.linspace(0, len(voting) - 1, _MOST_KEYFRAMES).astype(int)) if voting]
    if len(voting) < _LEAST_KEYFRAMES:
        return None
    detector = cv2.createLineSegmentDetector(0)
    parts = [segments_of(k, points[k.id], camera, detector, number) for number, k in enumerate(voting)]
    return vertical(_joined(parts), np.stack([k.T_c_w[:3, :3].T for k in voting]), camera.focal_sigma)


def vertical(segments: Segments, R_w_c: FloatArray, focal_sigma: float = 0.0) -> Up | None:
    """Where up is by segments; None where they do not tell.

    Args:
        segments: Of all keyframes.
        R_w_c: ``(K, 3, 3)`` the keyframes' rotations, in the order of time.
        focal_sigma: Relative, of the camera.
    """
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
    same = np.abs(axes @ axes[int(likely.argmax())]) >= _ELSEWHERE
    rivals = likely[~same]
    support = _support(axes, segments)
    best = axes[int(np.where(same, support.along + support.square, -1.0).argmax())]
    share = _support(best[None], segments)
    upward = float(best @ image_up) / max(float(np.linalg.norm(image_up)), 1e-6)
    told = float(share.along[0] + share.square[0])
    if told < _LEAST or likely.max() < _ODDS * max(rivals, default=0.0) or upward < _FAR_FROM_UP:
        return None
    by_depth = float(share.across[0] / (share.across[0] + _CIRCLES_TELL * share.along[0]))
    sigma = math.hypot(_BUILT_RAD, _DEPTH_RAD * by_depth, _jackknife(best, segments), 0.5 * focal_sigma)
    return Up(best, sigma, "edges") if sigma < _MAX_SIGMA else None


def segments_of(
    keyframe: Keyframe, points: EdgePoints, camera: Camera, detector: cv2.LineSegmentDetector, number: int
) -> Segments:
    """Segments of one keyframe whose depth its edges tell; a line's inverse depth is affine along its picture."""
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
    """Directions ``(D, 3)`` of segments, and those that lie across two of them."""
    rng = np.random.default_rng(0)
    i, j = rng.integers(len(segments.length), size=(2, _CANDIDATES))
    d = segments.direction
    crossed = np.cross(d[i], d[j])
    return np.concatenate([d, _unit(crossed[np.linalg.norm(crossed, axis=1) > 0.3])])


def _weights(v: FloatArray, segments: Segments, blur: float = 1.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How well segments lie along and across directions ``(D, 3)``, ``(D, S)`` each, and sigma of the latter [rad]."""
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
    """Of those across, the part that lies across the rest of them: one direction alone has a whole circle across it."""


def _support(v: FloatArray, segments: Segments) -> _Support:
    """What lies along and across directions ``(D, 3)``."""
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
        left[np.abs(v @ peaks[-1]) > _APART] = 0.0
    return peaks


def _refined(v: FloatArray, segments: Segments) -> FloatArray:
    """The direction near another that segments along and across it agree on."""
    for blur in _BLURS:
        along, across, level = (x[0] for x in _weights(v[None], segments, blur))
        n, d = segments.normal, segments.direction
        information = (n * (segments.length * along / (blur * _CIRCLE_RAD) ** 2)[:, None]).T @ n
        information += (d * (segments.length * across / level**2)[:, None]).T @ d
        better = np.linalg.eigh(information)[1][:, 0]
        v = better if better @ v >= 0 else -better
    return v


def _likelihood(v: FloatArray, segments: Segments, R_w_c: FloatArray) -> float:
    """How likely a direction is up, up to a factor."""
    turns = np.cross(R_w_c[:-1, :, 2], R_w_c[1:, :, 2]) + np.cross(R_w_c[:-1, :, 0], R_w_c[1:, :, 0])
    turns = turns + np.cross(R_w_c[:-1, :, 1], R_w_c[1:, :, 1])  # twice the rotation vectors, nearly
    about = float(np.mean((turns @ v) ** 2) / max(float(np.mean(turns**2)), 1e-12))
    roll = np.arcsin(np.clip(R_w_c[:, :, 0] @ v, -1.0, 1.0))
    pitch = np.arcsin(np.clip(R_w_c[:, :, 2] @ v, -1.0, 1.0))
    held = np.exp(-0.5 * ((roll / _ROLL_RAD) ** 2 + ((pitch - _USUAL_PITCH_RAD) / _PITCH_RAD) ** 2))
    return (_ANY_WAY + float(held.mean())) * (about + 0.01) * float(_support(v[None], segments).across[0])


def _jackknife(best: FloatArray, segments: Segments) -> float:
    """Standard deviation [rad] of a direction by leaving out parts of the run in turn."""
    count = float(segments.keyframe.max()) + 1.0
    block = np.minimum(segments.keyframe * _BLOCKS // count, _BLOCKS - 1)
    without = np.stack([_refined(best, segments.take(np.flatnonzero(block != b))) for b in range(_BLOCKS)])
    off = np.arccos(np.clip(without @ best, -1.0, 1.0))
    return math.sqrt((_BLOCKS - 1) / _BLOCKS * float(np.sum(off**2)))
