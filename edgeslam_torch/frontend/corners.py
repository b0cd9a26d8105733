"""L-junctions: two straight Canny edges that meet in a corner, paper section on the L-shape loss (fig. 2)."""

from dataclasses import dataclass

import cv2
import numpy as np

from edgeslam_torch.types import FloatArray


@dataclass(frozen=True, slots=True)
class Junctions:
    """L-junctions of one image; ``C`` of them, longest arms first."""

    uv: FloatArray
    """``(C, 2)`` corner, the intersection of the two fitted lines [px], float64."""
    arms: FloatArray
    """``(C, 2, 2)`` unit directions away from the corner, clockwise in the image (u right, v down)."""
    length_px: FloatArray
    """``(C, 2)`` straight length of each arm [px]."""
    angle_rad: FloatArray
    """``(C,)`` angle between the arms, in (0, pi)."""
    sigma_px: FloatArray
    """``(C,)`` standard deviation of the corner per coordinate [px]."""
    sigma_rad: FloatArray
    """``(C, 2)`` standard deviation of each arm's direction."""

    def __len__(self) -> int:
        return len(self.uv)

    def arm_points(self, count: int, max_px: float = 40.0) -> tuple[FloatArray, FloatArray]:
        """Points along the arms, for their depths: pixels ``(C, 2, count, 2)`` and fractions ``(C, 2, count)``.

        Fractions are 0 at the corner and 1 at the last point, at most ``max_px`` away.
        """
        fraction = np.broadcast_to(np.linspace(1.0 / count, 1.0, count), (len(self), 2, count))
        reach = np.minimum(self.length_px, max_px)[..., None, None]
        uv = self.uv[:, None, None] + self.arms[:, :, None] * fraction[..., None] * reach
        return uv, fraction


@dataclass(frozen=True, slots=True)
class JunctionConfig:
    """Thresholds of an L-junction."""

    min_arm_px: float = 14.0
    """Shorter arms have a direction sigma above about 2 degrees."""
    angle_min_rad: float = np.radians(35.0)
    angle_max_rad: float = np.radians(145.0)
    """Flatter angles are bends of a single edge."""
    bend_px: float = 1.5
    """Maximum distance of a straight contour from its chord."""
    trim_px: int = 4
    """Pixels ignored at each end of an arm, where smoothing rounds the corner."""
    rms_px: float = 0.5
    """Maximum RMS distance of an arm's pixels from its line."""
    gap_px: float = 5.0
    """Maximum distance of the lines' intersection from the contour's turning point."""
    most: int = 150


def detect_junctions(grey: np.ndarray, edges: np.ndarray, config: JunctionConfig | None = None) -> Junctions:
    """Find L-junctions in Canny contours.

    Contours are split into straight segments; a line is fitted to the sub-pixel edge points of each; consecutive
    segments form a junction where their lines intersect.

    Args:
        grey: Undistorted image ``(H, W)`` uint8.
        edges: Its Canny edges ``(H, W)``, non-zero on edges.
        config: Thresholds.
    """
    config = config or JunctionConfig()
    points, runs = _straight_runs(edges, config)
    if len(runs) == 0:
        return _pack([], config)
    fit = _fit_lines(_on_ridge(grey, points), runs, config)
    return _pack(_corners(points, runs, fit, config), config)


@dataclass(frozen=True, slots=True)
class _Lines:
    """Lines fitted to runs of contour points."""

    centre: FloatArray
    direction: FloatArray
    along: FloatArray
    """Variance of the points along the line [px^2]."""
    sigma: FloatArray
    """Standard deviation of the line's offset at its centre [px]."""
    good: np.ndarray


def _straight_runs(edges: np.ndarray, config: JunctionConfig) -> tuple[np.ndarray, np.ndarray]:
    """Contour points ``(P, 2)`` and straight runs ``(S, 4)``: first point, end, contour, next run of the contour."""
    mask = (np.asarray(edges) != 0).astype(np.uint8)
    contours, _ = cv2.findContours(mask, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    points: list[np.ndarray] = []
    runs: list[tuple[int, int, int, int]] = []
    at = 0
    for number, contour in enumerate(contours):
        n = len(contour)
        if n < 4 * config.min_arm_px:  # two arms, out and back
            continue
        turns = _turning_points(contour, config.bend_px)
        if len(turns) < 2:
            continue
        # Start at a turning point and go round once.
        rolled = np.roll(contour[:, 0], -turns[0], axis=0)
        places = [*(turns - turns[0]), n]
        first = len(runs)
        for a, b in zip(places[:-1], places[1:], strict=True):
            runs.append((at + a, at + b, number, len(runs) + 1))
        runs[-1] = (*runs[-1][:3], first)
        points.append(rolled)
        at += n
    if not runs:
        return np.zeros((0, 2)), np.zeros((0, 4), int)
    return np.concatenate(points).astype(np.float64), np.array(runs)


def _turning_points(contour: np.ndarray, bend_px: float) -> np.ndarray:
    """Indices of the polygon's corners in a closed contour, ascending."""
    corners = cv2.approxPolyDP(contour, bend_px, True)[:, 0].astype(np.int64)
    code = contour[:, 0, 0].astype(np.int64) * 65536 + contour[:, 0, 1]
    order = np.argsort(code, kind="stable")
    wanted = corners[:, 0] * 65536 + corners[:, 1]
    # A thin line is traced in both directions, so a pixel may occur twice in its contour: take the occurrence that
    # preserves the order.
    lo, hi = np.searchsorted(code[order], wanted), np.searchsorted(code[order], wanted, side="right")
    places, last = [], -1
    shift = int(order[lo[0]])
    for a, b in zip(lo, hi, strict=True):
        visits = np.sort((order[a:b] - shift) % len(code))
        later = visits[visits > last]
        if len(later) == 0:
            continue
        last = int(later[0])
        places.append(last)
    return np.array(sorted((p + shift) % len(code) for p in places))


def _on_ridge(grey: np.ndarray, points: np.ndarray) -> FloatArray:
    """Edge points ``(P, 2)`` moved along the gradient to its maximum, by a parabola through 3 samples."""
    smooth = cv2.GaussianBlur(np.asarray(grey), (5, 5), 1.0)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    strength = np.sqrt(gx * gx + gy * gy)  # the last bits of cv2.magnitude vary between calls
    u, v = points[:, 0].astype(int), points[:, 1].astype(int)
    norm = np.maximum(strength[v, u], 1e-6)
    n = np.stack((gx[v, u] / norm, gy[v, u] / norm), 1)
    before, after = (_sample(strength, points + step * n) for step in (-1.0, 1.0))
    curvature = before - 2.0 * norm + after
    offset = np.where(curvature < -1e-6, 0.5 * (before - after) / np.minimum(curvature, -1e-6), 0.0)
    return points + np.clip(offset, -0.75, 0.75)[:, None] * n


def _sample(image: np.ndarray, uv: FloatArray) -> FloatArray:
    out = []
    for part in np.array_split(uv.astype(np.float32), len(uv) // 30000 + 1):  # cv2.remap indexes with 16 bits
        x, y = np.ascontiguousarray(part[:, :1]), np.ascontiguousarray(part[:, 1:])
        out.append(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel())
    return np.concatenate(out).astype(np.float64)


def _fit_lines(points: FloatArray, runs: np.ndarray, config: JunctionConfig) -> _Lines:
    """Total least squares line of each run, without its ends."""
    first, end = runs[:, 0] + config.trim_px, runs[:, 1] - config.trim_px + 1
    long = end - first >= max(6, int(config.min_arm_px) - 2 * config.trim_px)
    first, end = np.where(long, first, 0), np.where(long, end, 2)
    origin = points.mean(0)
    x, y = (points - origin).T
    sums = np.concatenate((np.zeros((5, 1)), np.cumsum(np.stack((x, y, x * x, x * y, y * y)), 1)), 1)
    count = (end - first).astype(np.float64)
    mx, my, xx, xy, yy = (sums[:, end] - sums[:, first]) / count
    sxx, sxy, syy = xx - mx * mx, xy - mx * my, yy - my * my
    angle = 0.5 * np.arctan2(2.0 * sxy, sxx - syy)
    spread = np.hypot(0.5 * (sxx - syy), sxy)
    mean = 0.5 * (sxx + syy)
    across = np.sqrt(np.maximum(mean - spread, 0.0))
    # Smoothing correlates about 3 neighbours, so a third of the points count; 0.1 px is the error on a noise-free
    # edge.
    sigma = np.maximum(across, 0.1) / np.sqrt(count / 3.0)
    return _Lines(
        centre=np.stack((mx, my), 1) + origin,
        direction=np.stack((np.cos(angle), np.sin(angle)), 1),
        along=np.maximum(mean + spread, 1e-9),
        sigma=sigma,
        good=long & (across <= config.rms_px),
    )


def _corners(points: np.ndarray, runs: np.ndarray, fit: _Lines, config: JunctionConfig) -> list[FloatArray]:
    """Rows of `_pack` for pairs of consecutive runs."""
    # A rounded corner may leave a short segment between its arms: skip it.
    following = runs[:, 3]
    short = runs[:, 1] - runs[:, 0] <= config.gap_px
    following = np.where(short[following], following[following], following)
    one = np.flatnonzero(fit.good & fit.good[following] & (following != np.arange(len(runs))))
    two = following[one]
    turn = points[runs[two, 0]]
    normal = [np.stack((-fit.direction[k, 1], fit.direction[k, 0]), 1) for k in (one, two)]
    offset = [(n * fit.centre[k]).sum(1) for n, k in zip(normal, (one, two), strict=True)]
    det = normal[0][:, 0] * normal[1][:, 1] - normal[0][:, 1] * normal[1][:, 0]
    safe = np.where(np.abs(det) > 0.3, det, 1.0)
    corner = np.stack(
        (
            (offset[0] * normal[1][:, 1] - offset[1] * normal[0][:, 1]) / safe,
            (offset[1] * normal[0][:, 0] - offset[0] * normal[1][:, 0]) / safe,
        ),
        1,
    )
    far = [points[runs[one, 0]], points[runs[runs[two, 3], 0]]]
    arms, lengths, line_var, angle_var = [], [], [], []
    for k, end in zip((one, two), far, strict=True):
        sign = np.sign((fit.direction[k] * (end - corner)).sum(1))
        arms.append(fit.direction[k] * np.where(sign == 0, 1.0, sign)[:, None])
        lengths.append(((end - corner) * arms[-1]).sum(1))
        lever = ((corner - fit.centre[k]) * fit.direction[k]).sum(1)
        line_var.append(fit.sigma[k] ** 2 * (1.0 + lever**2 / fit.along[k]))
        angle_var.append(fit.sigma[k] ** 2 / fit.along[k])
    cos = np.clip((arms[0] * arms[1]).sum(1), -1.0, 1.0)
    angle = np.arccos(cos)
    sigma_px = np.sqrt((line_var[0] + line_var[1]) / (2.0 * np.maximum(safe**2, 0.09)))
    keep = (
        (np.abs(det) > 0.3)
        & (np.linalg.norm(corner - turn, axis=1) < config.gap_px)
        & (np.minimum(*lengths) >= config.min_arm_px)
        & (angle > config.angle_min_rad)
        & (angle < config.angle_max_rad)
    )
    columns = (corner, *arms, np.stack(lengths, 1), angle[:, None], sigma_px[:, None], np.sqrt(np.stack(angle_var, 1)))
    return list(np.concatenate(columns, 1)[keep])


def _pack(rows: list[FloatArray], config: JunctionConfig) -> Junctions:
    """Unique junctions (a thin line is traced on both sides), longest arms first."""
    table = np.array(rows).reshape(-1, 12)
    flip = table[:, 2] * table[:, 5] - table[:, 3] * table[:, 4] < 0  # second arm anticlockwise of the first
    table[flip] = table[flip][:, [0, 1, 4, 5, 2, 3, 7, 6, 8, 9, 11, 10]]
    table = table[np.argsort(-np.minimum(table[:, 6], table[:, 7]), kind="stable")]
    kept: list[int] = []
    for k, row in enumerate(table):
        near = [j for j in kept if np.abs(table[j, :2] - row[:2]).max() < 4.0]
        same = any(table[j, 2:4] @ row[2:4] > 0.94 and table[j, 4:6] @ row[4:6] > 0.94 for j in near)
        if not same:
            kept.append(k)
        if len(kept) == config.most:
            break
    table = table[kept]
    return Junctions(
        uv=table[:, :2],
        arms=table[:, 2:6].reshape(-1, 2, 2),
        length_px=table[:, 6:8],
        angle_rad=table[:, 8],
        sigma_px=table[:, 9],
        sigma_rad=table[:, 10:12],
    )
