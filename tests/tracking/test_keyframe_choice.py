"""What earlier visits have seen needs no keyframe; few anchors, another side or another distance do."""

import math
from dataclasses import replace

import numpy as np
import pytest
from point_map import CAMERA, filled

from edgeslam_torch.config import MappingConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.tracking.keyframe_choice import KNOWN_SHARE, LONG_AGO_S, OLD_S, known_share
from edgeslam_torch.tracking.tracker import Track

LATER_S = 100.0
SOON_S = 5.0 + 0.5 * (OLD_S + LONG_AGO_S)
"""Where all six keyframes, a second apart, are of an earlier visit, and none is of long ago."""


@pytest.fixture(scope="module")
def visited():
    return filled(np.random.default_rng(3), 1500, 6)


def again(points, view=2, T_c_w=None):
    """A frame that sees what a keyframe saw, from the same place or another one, and all its keypoints."""
    keyframe = points.keyframes[view]
    held = keyframe.keypoints_with_anchor()
    T = keyframe.T_c_w if T_c_w is None else T_c_w
    track = Track(T, held, keyframe.anchor[held], held, keyframe.anchor[held], np.eye(6))
    return track, keyframe.features.uv.astype(np.float64)


def share(points, track, uv, stamp_s=LATER_S):
    return known_share(track, uv, stamp_s, points.map, CAMERA, MappingConfig())


def test_a_view_of_an_earlier_visit_is_covered(visited):
    assert share(visited, *again(visited)) > 0.95


def test_a_recent_view_is_no_earlier_visit(visited):
    """Six keyframes a second apart: the oldest is five seconds old."""
    assert share(visited, *again(visited), stamp_s=OLD_S - 1e-3) == 0.0
    assert share(visited, *again(visited), stamp_s=OLD_S + 5.0) > 0.95


def test_a_loaded_map_is_an_earlier_visit_and_predicted_depths_are_not_covered():
    points = filled(np.random.default_rng(3), 1500, 6)
    for keyframe in points.keyframes:
        keyframe.stamp_s = -math.inf
    assert share(points, *again(points), stamp_s=0.0) > 0.95
    points.map.anchors.from_depth[:] = True
    assert share(points, *again(points)) == 0.0


def test_a_half_without_matches_is_not_covered(visited):
    track, uv = again(visited)
    left = uv[track.keypoint, 0] < 0.5 * CAMERA.width
    half = replace(track, keypoint=track.keypoint[left], anchor=track.anchor[left])
    assert 0.4 < share(visited, half, uv) < 0.6 < KNOWN_SHARE


def from_elsewhere(points, shift):
    """The same anchors from a camera moved by a share of the depth along its own axes."""
    keyframe = points.keyframes[2]
    T_w_c = keyframe.T_w_c.copy()
    T_w_c[:3, 3] += T_w_c[:3, :3] @ (np.array(shift) * points.map.median_depth(keyframe))
    return se3.inverse(T_w_c)


@pytest.mark.parametrize(
    ("shift", "soon", "later"),
    [
        ((0.0, -0.3, 0.0), (0.0, 0.3), (0.0, 1.0)),  # fifteen degrees of parallax
        ((0.0, 0.0, -0.6), (0.0, 0.3), (0.0, 1.0)),  # 1.6 times as far, which is two pyramid levels
        ((0.0, -0.1, 0.0), (0.0, 0.8), (0.8, 1.0)),  # some six degrees
        ((0.0, 0.0, -0.1), (0.0, 0.8), (0.8, 1.0)),  # a tenth farther, two pyramid levels for the nearest
        ((0.0, -0.8, 0.0), (0.0, 0.3), (0.0, 0.4)),  # thirty degrees
        ((0.0, 0.0, -1.5), (0.0, 0.3), (0.0, 0.4)),  # 2.5 times as far, which is five pyramid levels
    ],
)
def test_other_directions_and_distances_are_covered_by_a_completed_visit_if_similar(visited, shift, soon, later):
    frame = again(visited, T_c_w=from_elsewhere(visited, shift))
    assert soon[0] <= share(visited, *frame, stamp_s=SOON_S) <= soon[1]
    assert later[0] <= share(visited, *frame) <= later[1]


def thinned(points, among, every):
    """A frame that sees what keyframes have seen, but finds one in some of the anchors and only among those given."""
    track, uv = again(points)
    kept = np.flatnonzero(among(uv[track.keypoint]))[::every]
    return replace(track, keypoint=track.keypoint[kept], anchor=track.anchor[kept]), uv


def test_a_completed_visit_covers_expected_anchors_without_matches(visited):
    """A third is found again in the same place, spread over the view."""
    track, uv = thinned(visited, lambda uv: uv[:, 0] >= 0, 3)
    assert share(visited, track, uv) > 0.9


def test_a_part_without_any_matches_has_changed(visited):
    track, uv = thinned(visited, lambda uv: uv[:, 0] < 0.5 * CAMERA.width, 1)
    assert share(visited, track, uv) < KNOWN_SHARE
