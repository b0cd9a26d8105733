"""Focal length of a camera from its own images: ``E = K^T F K`` must be an essential matrix.

For an unknown camera it replaces a guess; a calibration is checked with it.

The paper assumes a known K to convert F to E. With the principal point at the image's centre, square
pixels and one focal length for all images, F of one pair determines the focal length: the two non-zero singular
values of ``K^T F K`` are equal (Mendonca and Cipolla, CVPR 1999; Sturm, CVPR 2001, gives the same zero in closed
form). One pair is off by 5 to 50 %, the median of tens of pairs by a few per cent; planes, rotations, forward motion
and pairs whose halves disagree are rejected first.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np

from edgeslam_torch.config import OrbConfig
from edgeslam_torch.frontend.matching import match_all, words
from edgeslam_torch.frontend.orb import OrbExtractor
from edgeslam_torch.geometry.camera import GUESSED_FOCAL_SIGMA, Camera
from edgeslam_torch.geometry.robust_statistics import robust_sigma
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.optim.blocks import POINT_DELTA
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.problem import LmConfig, ScalePrior, WindowProblem, WindowResult
from edgeslam_torch.types import FloatArray, IntArray

MAX_FRAMES = 40
MIN_PAIRS = 5
"""Minimum number of usable pairs."""
MAX_RELATIVE_SIGMA = 0.15
"""Maximum relative sigma of an estimate; above, it is no better than the guess."""

_CHECKED_PAIRS = 120
"""Number of keyframe pairs for checking a calibration: half a second of CPU, once per run."""
_CHECKED_GAPS = (1, 2, 3)
_MIN_CHECKED = 10
"""Minimum number of pairs to contradict a calibration; with seven, errors of 25 % occur."""
_CONTRADICTION_SIGMAS = 2.5
_CONTRADICTION = 0.1
"""Minimum relative difference of a contradiction, above the error of the map's refinement: up to 3 % in general, 7 % on
planes. A wrong focal length is half hidden by the map made with it: 30 % too long is found to be 12 to 17 %. Planes,
motion along the axis and strong distortion hide all of it."""
_MIN_REFINED = 20
"""Minimum number of keyframes: a short sideways motion fits half the focal length with other depths, with a meaningless
sigma."""
_REFINED_KEYFRAMES, _REFINED_ANCHORS = 40, 600
"""Maximum numbers of keyframes and anchors for a refinement with a free focal length: up to half a second of CPU, once
per run."""
_REFINEMENT = LmConfig(diagnostics=False, max_iterations=30, mu=1e-8, cost_tolerance=1e-6, pose_tolerance=0.1)
"""Accurate poses: the derivative of the cost by the focal length is that of the minimum."""
_NEWTON_STEPS, _FOCAL_STEP, _MAX_MOVE, _CONVERGED = 10, 0.04, 0.25, 0.01
"""Newton's method for the log focal length: number of steps, step of the numerical derivative, largest change, and
convergence threshold."""
_OPTIMISM = 8.0
"""Ratio of true to formal sigma, measured as 3 to 8: errors of the lens model and of neighbouring views are
correlated."""
_CHI2_MEDIAN = 1.386
"""Median of chi-square with two degrees of freedom."""

_GAPS = (1, 2, 3, 5, 8)
"""Frames between the two images of a pair."""
_MIN_MATCHES = 50
_MIN_MOTION = 0.02
"""Median displacement relative to the longer image side."""
_MAX_EXPLAINED = 0.8
"""Maximum share of inliers explained by a homography; planes and rotations reach 1."""
_FORWARD = 0.1
"""Distance of both epipoles from the centre, relative to the longer side, below which the motion is along the
axis."""
_HALVES = 6
_MAX_SPREAD = 0.15
"""Standard deviation of the log focal lengths of random halves of a pair's inliers."""
_SHARED = 4.0
"""Correlated pairs that count as one, since pairs share frames."""
_GRID = np.exp(np.linspace(np.log(0.3), np.log(3.0), 120))
"""Focal lengths tried, relative to the longer side: from 120 degrees to a telephoto lens."""


class Refused(StrEnum):
    """Reasons why a pair of images does not determine the focal length."""

    FEW_MATCHES = "too few matches"
    LOW_PARALLAX = "hardly any motion"
    HOMOGRAPHY = "a plane or a pure rotation explains the matches"
    FORWARD = "pure forward motion"
    UNSTABLE = "the focal length depends on which matches are used"


@dataclass(frozen=True, slots=True)
class FocalEstimate:
    """Focal length found in pairs of images."""

    focal_px: float | None
    """None without usable pairs."""
    sigma_px: float
    """Standard deviation; infinite without usable pairs."""
    pairs_used: int
    reason: str
    """Reason for a missing estimate; empty otherwise."""


def focal_from_matches(pairs: Sequence[tuple[FloatArray, FloatArray]], width: int, height: int) -> FocalEstimate:
    """Median focal length over pairs of images.

    Args:
        pairs: Matched pixels ``(M, 2)`` in both images of each pair, including outliers.
        width: Of the images [px].
        height: Of the images [px].
    """
    found: list[float] = []
    refused: Counter[Refused] = Counter()
    for uv_i, uv_j in pairs:
        result = _focal_of_pair(uv_i, uv_j, width, height)
        if isinstance(result, Refused):
            refused[result] += 1
        else:
            found.append(result)
    if len(found) < MIN_PAIRS:
        why = f"; most often {refused.most_common(1)[0][0]}" if refused else ""
        return FocalEstimate(None, np.inf, len(found), f"{len(found)} of {len(pairs)} image pairs usable{why}")
    logs = np.log(found)
    centre = float(np.median(logs))
    spread = robust_sigma(logs - centre)
    # The median of n normal samples has a sigma of 1.2533 sigma / sqrt(n); 2 % for common errors (lens, centre).
    relative = float(np.hypot(1.2533 * spread / np.sqrt(len(found) / _SHARED), 0.02))
    if relative > MAX_RELATIVE_SIGMA:
        return FocalEstimate(None, np.inf, len(found), f"{len(found)} image pairs disagree by {100 * spread:.0f} %")
    focal = float(np.exp(centre))
    return FocalEstimate(focal, relative * focal, len(found), "")


def guess_camera(frames: Sequence[np.ndarray], width: int, height: int) -> Camera:
    """Camera for images of an unknown lens.

    Args:
        frames: Some images ``(H, W, 3)`` BGR or ``(H, W)`` grey from the start of a recording, in order, with motion
            and overlap; `MAX_FRAMES` of them are used.
        width: Of the images [px].
        height: Of the images [px].

    Returns:
        Principal point in the middle, no distortion; ``source`` has the origin of the focal length, ``focal_sigma``
        its uncertainty.
    """
    estimate = focal_from_matches(_matched_pairs(_spread(frames), width, height), width, height)
    if estimate.focal_px is None:
        focal, sigma = 1.2 * max(width, height), GUESSED_FOCAL_SIGMA
        source = f"guess: 1.2*max(w,h) = {focal:.0f} px ({estimate.reason})"
    else:
        focal, sigma = estimate.focal_px, estimate.sigma_px / estimate.focal_px
        source = (
            f"focal from the fundamental matrix: {focal:.0f} +- {estimate.sigma_px:.0f} px "
            f"over {estimate.pairs_used} pairs"
        )
    centre = ((width - 1) / 2.0, (height - 1) / 2.0)
    return Camera(width, height, focal, focal, *centre, source=source, focal_sigma=sigma)


def calibration_warning(camera: Camera, keyframes: Sequence[Keyframe], p_w: FloatArray | None = None) -> str | None:
    """Check a calibration against the images of its run.

    The matches are the map's anchors. Most come from optical flow, which is independent of the calibration.

    Args:
        camera: As the run used it.
        keyframes: In order, keypoints undistorted with that camera.
        p_w: The map's anchors ``(A, 3)`` by id; None to go by fundamental matrices alone.

    Returns:
        A warning if a refinement of the map with a free focal length contradicts the focal length, or where the map
        fits none, fundamental matrices of neighbours; None if they agree or the motion is insufficient.
    """
    if camera.focal_sigma > MAX_RELATIVE_SIGMA:
        return None
    estimate = None if p_w is None else focal_from_map(camera, keyframes, p_w)
    if estimate is None or estimate.focal_px is None:
        estimate = _focal_from_keyframes(camera, keyframes)
    if estimate.focal_px is None or not contradicts(estimate, camera):
        return None
    return (
        "the images contradict the calibration: they suggest a focal length of "
        f"{estimate.focal_px:.0f} +- {estimate.sigma_px:.0f} px, {camera.source} says {camera.fx:.0f} px; "
        "is it of this lens, at this zoom and resolution?"
    )


def focal_from_map(camera: Camera, keyframes: Sequence[Keyframe], p_w: FloatArray) -> FocalEstimate:
    """Focal length that minimises the reprojection error of the first keyframes and their anchors.

    Newton's method on the cost of the refined map, a function of the focal length alone.

    Args:
        camera: Calibration of the map.
        keyframes: In order.
        p_w: Anchors ``(A, 3)`` by id.
    """
    problem = _map_problem(camera, keyframes[:_REFINED_KEYFRAMES], p_w)
    if problem is None:
        return FocalEstimate(None, np.inf, 0, "too small a map")
    log_scale, last, limit = 0.0, 0.0, _MAX_MOVE
    for _ in range(_NEWTON_STEPS):
        here = _refined_with(problem, camera, log_scale)
        problem = replace(problem, T_c_w=here.T_c_w, p_w=here.p_w)
        slope = _slope(problem, camera, log_scale)
        there = _refined_with(problem, camera, log_scale + _FOCAL_STEP)
        beyond = _slope(replace(problem, T_c_w=there.T_c_w, p_w=there.p_w), camera, log_scale + _FOCAL_STEP)
        curvature = (beyond - slope) / _FOCAL_STEP
        move = -slope / curvature if curvature > 0 else -math.copysign(limit, slope)
        limit = limit / 3.0 if move * last < 0 else limit  # Huber's cost is not quadratic: steps overshoot
        last = move
        log_scale += float(np.clip(move, -limit, limit))
        enough = max(_CONVERGED, _CONTRADICTION / 3.0 - abs(log_scale))  # what agrees need not be exact
        if curvature > 0 and abs(move) < enough:
            noise = float(np.sqrt(np.median(here.chi2) / _CHI2_MEDIAN))
            focal = camera.fx * math.exp(log_scale)
            relative = math.hypot(_OPTIMISM * noise / math.sqrt(curvature), 0.02)
            return FocalEstimate(focal, relative * focal, len(problem.T_c_w), "")
    return FocalEstimate(None, np.inf, len(problem.T_c_w), "the map fits no focal length")


def _slope(problem: WindowProblem, camera: Camera, log_scale: float) -> float:
    """Derivative of a refined map's cost by the log focal length; poses and anchors are at their minimum."""
    scale, T = math.exp(log_scale), problem.T_c_w[problem.obs_pose]
    p_c = (T[:, :3, :3] @ problem.p_w[problem.obs_anchor][:, :, None])[:, :, 0] + T[:, :3, 3]
    front = p_c[:, 2] > 0
    p_c, uv, inv_sigma = p_c[front], problem.uv[front], problem.inv_sigma[front, None]
    from_centre = scale * np.array([camera.fx, camera.fy]) * p_c[:, :2] / p_c[:, 2:]
    r = (from_centre + [camera.cx, camera.cy] - uv) * inv_sigma
    weight = np.minimum(1.0, POINT_DELTA / np.maximum(np.linalg.norm(r, axis=1), 1e-12))  # Huber's
    return float(2.0 * (weight[:, None] * r * from_centre * inv_sigma).sum())


def _refined_with(problem: WindowProblem, camera: Camera, log_scale: float) -> WindowResult:
    scale = math.exp(log_scale)
    K = (camera.fx * scale, camera.fy * scale, camera.cx, camera.cy)
    return refine_window(replace(problem, K=K), _REFINEMENT)


def _map_problem(camera: Camera, keyframes: Sequence[Keyframe], p_w: FloatArray) -> WindowProblem | None:
    """Keyframes and their most observed anchors; None with too few keyframes or without motion."""
    if len(keyframes) < _MIN_REFINED:
        return None
    observed = [keyframe.keypoints_with_anchor() for keyframe in keyframes]
    anchor = np.concatenate([keyframe.anchor[at] for keyframe, at in zip(keyframes, observed, strict=True)])
    ids, seen = np.unique(anchor, return_counts=True)
    chosen = np.sort(ids[np.argsort(-seen, kind="stable")[:_REFINED_ANCHORS]][: np.count_nonzero(seen >= 3)])
    T_c_w = np.stack([keyframe.T_c_w for keyframe in keyframes])
    centres = np.stack([keyframe.centre_w for keyframe in keyframes])
    distance = np.linalg.norm(centres - centres[0], axis=1)
    far = int(np.argmax(distance))
    if len(chosen) < _MIN_MATCHES or distance[far] == 0.0:
        return None
    kept = np.isin(anchor, chosen)
    uv = np.concatenate([keyframe.features.uv[at] for keyframe, at in zip(keyframes, observed, strict=True)])
    pose = np.repeat(np.arange(len(keyframes)), [len(at) for at in observed])
    return WindowProblem(
        T_c_w=T_c_w,
        pose_fixed=np.arange(len(keyframes)) < 1,
        p_w=p_w[chosen],
        obs_pose=pose[kept],
        obs_anchor=np.searchsorted(chosen, anchor[kept]),
        uv=uv[kept].astype(np.float64),
        inv_sigma=np.ones(np.count_nonzero(kept)),
        K=(camera.fx, camera.fy, camera.cx, camera.cy),
        scale_priors=(ScalePrior(0, far, float(distance[far]), 1e-3),),
    )


def _focal_from_keyframes(camera: Camera, keyframes: Sequence[Keyframe]) -> FocalEstimate:
    """Median focal length of fundamental matrices of neighbouring keyframes."""
    pairs = [(i, i + gap) for i in range(len(keyframes)) for gap in _CHECKED_GAPS if i + gap < len(keyframes)]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _CHECKED_PAIRS)).round().astype(int))
    uv = [_centred(keyframe.features.uv, camera) for keyframe in keyframes]
    matched = []
    for i, j in (pairs[k] for k in chosen):
        at_i, at_j = _same_anchors(keyframes[i], keyframes[j])
        matched.append((uv[i][at_i], uv[j][at_j]))
    return focal_from_matches(matched, camera.width, camera.height)


def contradicts(estimate: FocalEstimate, camera: Camera) -> bool:
    """Whether an estimate contradicts the camera's focal length within its own uncertainty."""
    if estimate.focal_px is None or estimate.pairs_used < _MIN_CHECKED:
        return False
    difference = abs(math.log(estimate.focal_px / camera.fx))
    sigma = math.hypot(estimate.sigma_px / estimate.focal_px, camera.focal_sigma)
    return difference > max(math.log1p(_CONTRADICTION), _CONTRADICTION_SIGMAS * sigma)


def _centred(uv: FloatArray, camera: Camera) -> FloatArray:
    """Pixels of a camera with square pixels and centred principal point."""
    centre = [(camera.width - 1) / 2.0, (camera.height - 1) / 2.0]
    return (np.asarray(uv, np.float64) - [camera.cx, camera.cy]) * [1.0, camera.fx / camera.fy] + centre


def _same_anchors(a: Keyframe, b: Keyframe) -> tuple[IntArray, IntArray]:
    """Keypoints of both that observe the same anchors."""
    with_anchor_a, with_anchor_b = a.keypoints_with_anchor(), b.keypoints_with_anchor()
    _, at_a, at_b = np.intersect1d(a.anchor[with_anchor_a], b.anchor[with_anchor_b], return_indices=True)
    return with_anchor_a[at_a], with_anchor_b[at_b]


def _spread(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MAX_FRAMES)).round().astype(int))
    return [frames[i] for i in chosen]


def _matched_pairs(frames: list[np.ndarray], width: int, height: int) -> list[tuple[FloatArray, FloatArray]]:
    camera = Camera(width, height, width, width, (width - 1) / 2.0, (height - 1) / 2.0)
    orb = OrbExtractor(OrbConfig(features=700), camera)
    features = [orb(f if f.ndim == 2 else cv2.cvtColor(f, cv2.COLOR_BGR2GRAY)) for f in frames]
    bits = [words(f.descriptors) for f in features]
    pairs = []
    for gap in _GAPS:
        for i in range(0, len(frames) - gap, max(1, gap // 2)):
            m = match_all(bits[i], bits[i + gap], 64, 0.85)
            pairs.append((features[i].uv[m.query], features[i + gap].uv[m.train]))
    return pairs


def _focal_of_pair(uv_i: FloatArray, uv_j: FloatArray, width: int, height: int) -> float | Refused:
    """Focal length [px] of one pair, or the reason why there is none."""
    if len(uv_i) < _MIN_MATCHES:
        return Refused.FEW_MATCHES
    centre, side = np.array([(width - 1) / 2.0, (height - 1) / 2.0]), float(max(width, height))
    a, b = np.asarray(uv_i, np.float64) - centre, np.asarray(uv_j, np.float64) - centre
    if np.median(np.linalg.norm(a - b, axis=1)) < _MIN_MOTION * side:
        return Refused.LOW_PARALLAX
    try:
        F, mask = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, 1.0, 0.999, 5000)
    except cv2.error:  # OpenCV 5.0 fails on an empty model when no sample fits
        return Refused.FEW_MATCHES
    if F is None or F.shape != (3, 3) or mask.sum() < _MIN_MATCHES:
        return Refused.FEW_MATCHES
    inliers = np.flatnonzero(mask)
    H, explained = cv2.findHomography(a[inliers], b[inliers], cv2.USAC_MAGSAC, 2.0)
    if H is not None and explained.mean() > _MAX_EXPLAINED:
        return Refused.HOMOGRAPHY
    if max(_epipole_distance(F), _epipole_distance(F.T)) < _FORWARD * side:
        return Refused.FORWARD
    rng = np.random.default_rng(len(inliers))  # seeded per pair: independent of the order of pairs
    halves = []
    for _ in range(_HALVES):
        half = rng.permutation(inliers)[: len(inliers) // 2]
        halves.append(focal_of(cv2.findFundamentalMat(a[half], b[half], cv2.FM_8POINT)[0], side))
    focal = focal_of(F, side)
    if not np.isfinite([focal, *halves]).all() or np.std(np.log(halves)) > _MAX_SPREAD:
        return Refused.UNSTABLE
    return focal


def focal_of(F: FloatArray | None, side: float) -> float:
    """Focal length [px] that makes ``K^T F K`` an essential matrix; NaN when none between 0.3 and 3 sides does.

    Args:
        F: Fundamental matrix ``(3, 3)`` of pixels counted from the principal point.
        side: Longer side of the image [px].
    """
    if F is None or F.shape != (3, 3) or not np.isfinite(F).all():
        return np.nan
    K = np.zeros((len(_GRID), 3, 3))
    K[:, 0, 0] = K[:, 1, 1] = _GRID * side
    K[:, 2, 2] = 1.0
    s = np.linalg.svd(K @ F @ K, compute_uv=False)
    unequal = (1.0 - s[:, 1] / s[:, 0]) ** 2  # smooth at its zero
    k = int(np.argmin(unequal))
    if k in (0, len(_GRID) - 1):
        return np.nan
    before, at, after = unequal[k - 1 : k + 2]
    curvature = before - 2.0 * at + after
    shift = 0.5 * (before - after) / curvature if curvature > 0 else 0.0
    return float(_GRID[k] * (_GRID[1] / _GRID[0]) ** shift * side)


def _epipole_distance(F: FloatArray) -> float:
    """Distance [px] of an epipole to the origin."""
    e = np.linalg.svd(F)[2][2]
    return float(np.hypot(e[0], e[1]) / max(abs(e[2]), 1e-12))
