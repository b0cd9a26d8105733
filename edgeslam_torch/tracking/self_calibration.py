"""Focal length of a camera from its own images: ``E = K^T F K`` must be an essential matrix.

For an unknown camera it takes the place of a guess; a calibration is checked with it.

The paper takes K as known when it needs it to turn F into E. With the principal point at the image's centre, square
pixels and one focal length for all images, F of one pair determines the focal length: the two non-zero singular
values of ``K^T F K`` are equal (Mendonca and Cipolla, CVPR 1999; Sturm, CVPR 2001, gives the same zero in closed
form). One pair is off by 5 to 50 %, a median over tens of pairs by a few percent, thus planes, rotations, forward
motion and pairs whose halves disagree are refused first.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

import cv2
import numpy as np

from edgeslam_torch.config import OrbConfig
from edgeslam_torch.frontend.matching import match_all, words
from edgeslam_torch.frontend.orb import OrbExtractor
from edgeslam_torch.geometry.camera import GUESSED_FOCAL_SIGMA, Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.types import FloatArray, IntArray

MAX_FRAMES = 40
MIN_PAIRS = 5
"""Usable pairs below which nothing is said."""
MAX_RELATIVE_SIGMA = 0.15
"""Above this the estimate is no better than the guess that it would replace."""

_CHECKED_PAIRS = 120
"""Pairs of keyframes looked at to check a calibration: half a second of CPU, once a run."""
_CHECKED_GAPS = (1, 2, 3)
_LEAST_CHECKED = 10
"""Usable pairs below which a calibration is not doubted: to seven pairs of tum_fr1_xyz the right one looks 25 % off."""
_CONTRADICTION_SIGMAS = 2.5
_CONTRADICTION = 0.15
"""Relative difference. Over eight recordings right focal lengths came out at most 7 % (1.9 sigma) off. Of those made
0.7 and 1.3 times as long 10 in 15 are found; the others are those of tum_fr1_xyz, where the camera hardly turns, one of
icsl_corridor (planes), and euroc_mh05_a's, where a strong distortion, undone for the wrong length, hides them."""

_GAPS = (1, 2, 3, 5, 8)
"""Frames between the two images of a pair."""
_MIN_MATCHES = 50
_MIN_MOTION = 0.02
"""Median displacement relative to the longer image side."""
_MAX_EXPLAINED = 0.8
"""Share of the inliers that a homography may explain; a plane or a rotation explains all of them."""
_FORWARD = 0.1
"""Distance of both epipoles to the centre, relative to the longer side, below which the axes coincide."""
_HALVES = 6
_MAX_SPREAD = 0.15
"""Standard deviation of the log focal lengths of random halves of a pair's inliers."""
_SHARED = 4.0
"""Pairs that share frames are not independent: so many count as one."""
_GRID = np.exp(np.linspace(np.log(0.3), np.log(3.0), 120))
"""Focal lengths tried, relative to the longer side: from a 120 degree lens to a tele."""


class Refused(StrEnum):
    """Why a pair of images says nothing about the focal length."""

    FEW_MATCHES = "too few matches"
    LOW_PARALLAX = "hardly any motion"
    HOMOGRAPHY = "a plane or a pure rotation explains the matches"
    FORWARD = "pure forward motion"
    UNSTABLE = "the focal length depends on which matches are used"


@dataclass(frozen=True, slots=True)
class FocalEstimate:
    """Focal length found in pairs of images."""

    focal_px: float | None
    """None when there is nothing usable."""
    sigma_px: float
    """Standard deviation; infinite when there is nothing usable."""
    pairs_used: int
    reason: str
    """Why there is no estimate; empty when there is one."""


def focal_from_matches(pairs: Sequence[tuple[FloatArray, FloatArray]], width: int, height: int) -> FocalEstimate:
    """Median focal length over pairs of images.

    Args:
        pairs: Matched pixels ``(M, 2)`` in both images of each pair, wrong matches among them.
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
    spread = 1.4826 * float(np.median(np.abs(logs - centre)))
    # The median of n normal numbers scatters by 1.2533 sigma / sqrt(n); 2 % for what all pairs share (lens, centre).
    relative = float(np.hypot(1.2533 * spread / np.sqrt(len(found) / _SHARED), 0.02))
    if relative > MAX_RELATIVE_SIGMA:
        return FocalEstimate(None, np.inf, len(found), f"{len(found)} image pairs disagree by {100 * spread:.0f} %")
    focal = float(np.exp(centre))
    return FocalEstimate(focal, relative * focal, len(found), "")


def guess_camera(frames: Sequence[np.ndarray], width: int, height: int) -> Camera:
    """Camera for images of an unknown lens.

    Args:
        frames: Some images ``(H, W, 3)`` BGR or ``(H, W)`` grey from the start of a recording, in order, far enough
            apart to show motion and near enough to overlap; `MAX_FRAMES` of them are looked at.
        width: Of the images [px].
        height: Of the images [px].

    Returns:
        Principal point in the middle, no distortion; ``source`` says where the focal length is from, ``focal_sigma``
        how well it is known.
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


def calibration_warning(camera: Camera, keyframes: Sequence[Keyframe]) -> str | None:
    """What the images of a run say against its calibration.

    The matches are those of the map's anchors, at hand without another search. Most came by optical flow, which knows
    no calibration.

    Args:
        camera: As the run used it.
        keyframes: In order, keypoints undistorted with that camera.

    Returns:
        A sentence when the focal length that the fundamental matrices of neighbours tell is surely another one; None
        when it agrees or the motion does not tell.
    """
    pairs = [(i, i + gap) for i in range(len(keyframes)) for gap in _CHECKED_GAPS if i + gap < len(keyframes)]
    chosen = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), _CHECKED_PAIRS)).round().astype(int))
    uv = [_centred(keyframe.features.uv, camera) for keyframe in keyframes]
    matched = []
    for i, j in (pairs[k] for k in chosen):
        at_i, at_j = _same_anchors(keyframes[i], keyframes[j])
        matched.append((uv[i][at_i], uv[j][at_j]))
    estimate = focal_from_matches(matched, camera.width, camera.height)
    if estimate.focal_px is None or not contradicts(estimate, camera):
        return None
    return (
        f"the images contradict the calibration: {estimate.pairs_used} pairs of them suggest a focal length of "
        f"{estimate.focal_px:.0f} +- {estimate.sigma_px:.0f} px, {camera.source} says {camera.fx:.0f} px; "
        "is it of this lens, at this zoom and resolution?"
    )


def contradicts(estimate: FocalEstimate, camera: Camera) -> bool:
    """Whether an estimate is surely another focal length than the camera's, as far as that one is known."""
    if estimate.focal_px is None or estimate.pairs_used < _LEAST_CHECKED:
        return False
    difference = abs(math.log(estimate.focal_px / camera.fx))
    sigma = math.hypot(estimate.sigma_px / estimate.focal_px, camera.focal_sigma)
    return difference > max(math.log1p(_CONTRADICTION), _CONTRADICTION_SIGMAS * sigma)


def _centred(uv: FloatArray, camera: Camera) -> FloatArray:
    """Pixels as a camera sees them whose pixels are square and whose principal point is the image's centre."""
    centre = [(camera.width - 1) / 2.0, (camera.height - 1) / 2.0]
    return (np.asarray(uv, np.float64) - [camera.cx, camera.cy]) * [1.0, camera.fx / camera.fy] + centre


def _same_anchors(a: Keyframe, b: Keyframe) -> tuple[IntArray, IntArray]:
    """Keypoints of both that see the same anchors."""
    held_a, held_b = a.keypoints_with_anchor(), b.keypoints_with_anchor()
    _, at_a, at_b = np.intersect1d(a.anchor[held_a], b.anchor[held_b], return_indices=True)
    return held_a[at_a], held_b[at_b]


def _spread(frames: Sequence[np.ndarray]) -> list[np.ndarray]:
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(len(frames), MAX_FRAMES)).round().astype(int))
    return [frames[i] for i in chosen]


def _matched_pairs(frames: list[np.ndarray], width: int, height: int) -> list[tuple[FloatArray, FloatArray]]:
    camera = Camera(width, height, width, width, (width - 1) / 2.0, (height - 1) / 2.0)
    orb = OrbExtractor(OrbConfig(features=700, candidates=1500), camera)
    features = [orb(f if f.ndim == 2 else cv2.cvtColor(f, cv2.COLOR_BGR2GRAY)) for f in frames]
    bits = [words(f.descriptors) for f in features]
    pairs = []
    for gap in _GAPS:
        for i in range(0, len(frames) - gap, max(1, gap // 2)):
            m = match_all(bits[i], bits[i + gap], 64, 0.85)
            pairs.append((features[i].uv[m.query], features[i + gap].uv[m.train]))
    return pairs


def _focal_of_pair(uv_i: FloatArray, uv_j: FloatArray, width: int, height: int) -> float | Refused:
    """Focal length [px] of one pair, or why it gives none."""
    if len(uv_i) < _MIN_MATCHES:
        return Refused.FEW_MATCHES
    centre, side = np.array([(width - 1) / 2.0, (height - 1) / 2.0]), float(max(width, height))
    a, b = np.asarray(uv_i, np.float64) - centre, np.asarray(uv_j, np.float64) - centre
    if np.median(np.linalg.norm(a - b, axis=1)) < _MIN_MOTION * side:
        return Refused.LOW_PARALLAX
    try:
        F, mask = cv2.findFundamentalMat(a, b, cv2.USAC_MAGSAC, 1.0, 0.999, 5000)
    except cv2.error:  # OpenCV 5.0 trips over its own empty model when no sample fits anything
        return Refused.FEW_MATCHES
    if F is None or F.shape != (3, 3) or mask.sum() < _MIN_MATCHES:
        return Refused.FEW_MATCHES
    inliers = np.flatnonzero(mask)
    H, explained = cv2.findHomography(a[inliers], b[inliers], cv2.USAC_MAGSAC, 2.0)
    if H is not None and explained.mean() > _MAX_EXPLAINED:
        return Refused.HOMOGRAPHY
    if max(_epipole_distance(F), _epipole_distance(F.T)) < _FORWARD * side:
        return Refused.FORWARD
    rng = np.random.default_rng(len(inliers))  # of this pair alone: the order of pairs changes nothing
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
