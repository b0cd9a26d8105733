"""Keyframe selection by change of view and parallax."""

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.config import MappingConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.tracking.flow import Followed
from edgeslam_torch.tracking.relocaliser import GRID
from edgeslam_torch.tracking.tracker import Track
from edgeslam_torch.types import FloatArray, IntArray

SHORTEST_GAP_S = 0.04
"""Minimum time between keyframes whatever the change of view: every second frame at 30 Hz, every frame at 20."""
FOLLOWED = 0.9
"""Share of the last keyframe's keypoints below which flow requests a keyframe: a rotation by 6 degrees loses a tenth of
a 60-degree view."""
AT_ONCE = 0.75
"""Below this share, the minimum time between keyframes is ignored: after a rotation by 15 degrees since the last
keyframe, at 100 degrees a second, half the view would be lost meanwhile."""
OVERLAP = 0.7
"""Share of the reference keyframe's anchors below which matching requests a keyframe."""

OLD_S = 10.0
"""Age from which on a keyframe belongs to an earlier visit; more recent ones, of a shaking hand or a rotation in place,
are other views of the same visit, which improve the map (docs/decisions/03-keyframes.md)."""
KNOWN_SHARE = 0.8
"""Share of a view covered by earlier visits above which a keyframe is redundant: at least 0.81 from the third visit of
a place on, below 0.05 in new places."""
VISITS = 10
"""Number of keyframes of earlier visits that are compared, the most covisible ones."""
LONG_AGO_S = 30.0
"""Age from which on a keyframe belongs to a completed visit."""
MAX_VIEW_ANGLE_RAD = np.deg2rad(15.0)
"""Angle between two views of a place up to which their keypoints are recognised."""
MAX_LEVEL_DIFFERENCE = 2
"""Maximum difference of pyramid levels for recognition."""
CHANCE = 0.05
"""Significance level at which missing anchors indicate a change of the place."""


def lost_sight(followed: Followed) -> bool:
    """Whether flow tracks too few keypoints of the last keyframe."""
    return followed.share < FOLLOWED


def lost_most(followed: Followed) -> bool:
    """Whether flow tracks so few keypoints of the last keyframe that the next one is due at once: a fast rotation."""
    return followed.share < AT_ONCE


def due_by_flow(
    followed: Followed, parallax_rad: float, since_keyframe_s: float, config: MappingConfig, leans: bool = False
) -> bool:
    """Whether a frame tracked by flow should become a keyframe; arguments as in `is_due`."""
    changed, at_once = lost_sight(followed), lost_most(followed)
    return is_due(changed, parallax_rad, since_keyframe_s, config, at_once, leans)


def few_matches(track: Track, reference: Keyframe, slam_map: SlamMap) -> bool:
    """Whether too few of the reference keyframe's anchors are matched."""
    # Anchors of only two keyframes are unstable; overlap is measured on the others.
    observed = reference.anchor[reference.anchor >= 0]
    established = int((slam_map.anchors.observations[observed] >= min(3, len(slam_map.keyframes))).sum())
    return track.inliers < OVERLAP * established


def is_due(
    changed: bool,
    parallax_rad: float,
    since_keyframe_s: float,
    config: MappingConfig,
    at_once: bool = False,
    leans: bool = False,
) -> bool:
    """Whether a frame should become a keyframe.

    Args:
        changed: The view differs from the reference keyframe: `lost_sight` or `few_matches`.
        parallax_rad: Median ray angle to the reference keyframe.
        since_keyframe_s: Time since the last one.
        config: Thresholds.
        at_once: Ignore ``keyframe_min_gap_s``: `lost_most`.
        leans: The drone's attitude contradicts the pose; a window weighs both.
    """
    if since_keyframe_s < (SHORTEST_GAP_S if at_once else config.keyframe_min_gap_s):
        return False
    moved = parallax_rad > np.deg2rad(config.keyframe_parallax_deg)
    moved_little = parallax_rad > np.deg2rad(0.25 * config.keyframe_parallax_deg)
    overdue = since_keyframe_s >= config.keyframe_max_gap_s and (moved_little or leans)
    return changed or moved or overdue


def known_share(
    track: Track, uv: FloatArray, stamp_s: float, slam_map: SlamMap, camera: Camera, config: MappingConfig
) -> float:
    """Share of a view, in cells with keypoints, that keyframes of earlier visits cover.

    A cell is covered if a triangulated anchor is found in it that a keyframe of an earlier visit observed with less
    parallax than the keyframe threshold and within a pyramid level, so that a new keyframe would add nothing; or if a
    keyframe of a completed visit observed anchors that project there, from a similar direction, found now or not: in an
    unchanged place only a third of them is found again.

    Args:
        track: Anchors found in the frame.
        uv: All keypoints of the frame ``(N, 2)``.
        stamp_s: Stamp of the frame.
        slam_map: Holds the keyframes.
        camera: Intrinsics of the frame.
        config: Thresholds.
    """
    triangulated = ~slam_map.anchors.from_depth[track.anchor]
    anchor, keypoint = track.anchor[triangulated], track.keypoint[triangulated]
    counts = slam_map.shared_counts(anchor)
    order = sorted(counts, key=lambda id: (-counts[id], -id))
    visits = [slam_map.keyframes[id] for id in order if stamp_s - slam_map.keyframes[id].stamp_s >= OLD_S]
    long_ago = [k for k in visits if stamp_s - k.stamp_s >= LONG_AGO_S]
    seen = _seen_by(visits[:VISITS], track.T_c_w, slam_map, np.deg2rad(config.keyframe_parallax_deg), 1)
    expected = _seen_by(long_ago[:VISITS], track.T_c_w, slam_map, MAX_VIEW_ANGLE_RAD, MAX_LEVEL_DIFFERENCE)
    known = _keypoints_a_cell(camera, uv[keypoint[seen[anchor]]]) > 0
    known |= _as_expected(np.flatnonzero(expected), track, slam_map, camera)
    filled = _keypoints_a_cell(camera, uv) > 0
    return float((known & filled).sum() / max(1, int(filled.sum())))


def _seen_by(
    keyframes: list[Keyframe], T_c_w: FloatArray, slam_map: SlamMap, max_rad: float, levels: int
) -> NDArray[np.bool_]:
    """Mask of anchors that are triangulated and observed from a similar direction and distance."""
    anchors, centre = slam_map.anchors, se3.inverse(T_c_w)[:3, 3]
    seen = np.zeros(len(anchors.alive), dtype=bool)
    for keyframe in keyframes:
        observed = keyframe.anchor[keyframe.anchor >= 0]
        observed = observed[~anchors.from_depth[observed]]
        ray, other = anchors.p_w[observed] - centre, anchors.p_w[observed] - keyframe.centre_w
        distance, far = (np.maximum(np.sqrt(np.einsum("ij,ij->i", r, r)), 1e-12) for r in (ray, other))
        similar = np.abs(np.log(distance / far)) <= levels * np.log(slam_map.scale_factor)
        cosine = np.einsum("ij,ij->i", ray, other) / (distance * far)
        seen[observed[similar & (cosine >= np.cos(max_rad))]] = True
    return seen


def _as_expected(expected: IntArray, track: Track, slam_map: SlamMap, camera: Camera) -> NDArray[np.bool_]:
    """Cells in which anchors ``(M,)`` are expected, except those where a significant number is missing."""
    p_c = se3.transform(track.T_c_w, slam_map.anchors.p_w[expected])
    expected, p_c = expected[p_c[:, 2] > 0], p_c[p_c[:, 2] > 0]
    uv = camera.project(p_c)
    found = np.isin(expected, track.anchor)
    there = _keypoints_a_cell(camera, uv[found])
    if not there.any():
        return there > 0
    count = _keypoints_a_cell(camera, uv)
    enough = np.log(CHANCE) / np.log1p(-min(there.sum() / count.sum(), 0.99))
    return (there > 0) | ((count > 0) & (count <= enough))


def _keypoints_a_cell(camera: Camera, uv: FloatArray) -> IntArray:
    """Number of pixels ``(N, 2)`` in each cell of the image; undistorted ones may be outside."""
    column, row = np.floor(uv / (np.array([camera.width, camera.height]) / GRID)).astype(np.int64).T
    inside = (column >= 0) & (column < GRID[0]) & (row >= 0) & (row < GRID[1])
    return np.bincount((column + GRID[0] * row)[inside], minlength=GRID[0] * GRID[1])
