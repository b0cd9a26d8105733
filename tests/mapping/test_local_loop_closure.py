"""A returning camera observes its old anchors again despite drift."""

import math
from dataclasses import replace

import numpy as np
import pytest
from point_map import CAMERA, PointMap, add_anchors, check_map, filled, small_motion

from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.frontend.matching import words
from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.local_loop_closure import reobserve, revisit_candidate
from edgeslam_torch.mapping.refinement import refine_all
from edgeslam_torch.optim.problem import LmConfig

LATER = (3, 4, 5)


def drifted(rng, drift, same_place=True, turn_rad=0.0):
    """Views 3 to 5 with anchors of their own, all moved by ``drift`` or turned about view 1; the last of them stands
    where view 1 stood."""
    points = PointMap(rng, 400, 6)
    points.world.T_c_w[5] = points.world.T_c_w[1]
    last = points.keyframes[5]
    seen = points.point_of[5] = points.point_of[1]
    last.features = points.keyframes[1].features
    last.words, last.grid = points.keyframes[1].words, points.keyframes[1].grid
    last.aligned_px = points.keyframes[1].aligned_px.copy()
    last.anchor = np.full(len(seen), -1, dtype=np.int64)
    last.T_c_w = points.world.T_c_w[1].copy()
    if turn_rad:
        drift = se3.inverse(last.T_c_w) @ se3.exp(np.array([0.0, 0.0, 0.0, turn_rad, 0.0, 0.0])) @ last.T_c_w
    points.fill((0, 1, 2))
    known = np.unique(np.concatenate([points.point_of[v] for v in LATER]))
    if not same_place:
        points.descriptors = rng.integers(0, 256, points.descriptors.shape, dtype=np.uint8)
        last.words = words(points.descriptors[seen])
    anchor_of = np.full(len(points.world.p_w), -1)
    p_w = se3.transform(drift, points.world.p_w[known])
    anchor_of[known] = add_anchors(points.map, p_w, points.descriptors[known], 3)
    for v in LATER:
        keyframe = points.keyframes[v]
        keyframe.T_c_w = keyframe.T_c_w @ se3.inverse(drift)
        keyframe.anchor[:] = anchor_of[points.point_of[v]]
        points.map.add_keyframe(keyframe)
    points.map.refresh_anchors(anchor_of[known])
    return points


@pytest.fixture
def drift(rng):
    return small_motion(rng, 0.04, 0.02)


def test_a_returning_camera_is_matched_and_the_drift_corrected(rng, drift):
    points = drifted(rng, drift)
    last = points.keyframes[5]
    assert revisit_candidate(points.map, last) is points.keyframes[1]
    before = len(points.map.anchors)
    held = points.keyframes[1].keypoints_with_anchor()
    p_w = points.map.anchors.p_w[points.keyframes[1].anchor[held]]
    true = CAMERA.project(se3.transform(last.T_c_w @ drift, p_w))
    shift = np.linalg.norm(CAMERA.project(se3.transform(last.T_c_w, p_w)) - true, axis=1)
    assert reobserve(points.map, CAMERA, last) == pytest.approx(np.median(shift), rel=0.3)
    check_map(points.map)
    assert before - len(points.map.anchors) > 50
    for _ in range(2):
        refine_all(points.map, CAMERA, LmConfig(max_iterations=50, cost_tolerance=1e-9, diagnostics=False))
        for keyframe in points.keyframes:
            reobserve(points.map, CAMERA, keyframe)
    check_map(points.map)
    apart = se3.log(last.T_c_w @ se3.inverse(points.keyframes[1].T_c_w))
    assert np.abs(apart).max() < 0.1 * np.abs(se3.log(drift)).max()


def test_a_different_place_is_not_matched(rng, drift):
    points = drifted(rng, drift, same_place=False)
    held = points.keyframes[5].anchor.copy()
    assert reobserve(points.map, CAMERA, points.keyframes[5]) is None
    check_map(points.map)
    np.testing.assert_array_equal(points.keyframes[5].anchor, held)


def test_what_the_way_since_cannot_have_drifted_is_no_revisit(rng):
    """A neighbouring repetition of wallpaper fits as well as the place itself: here 5 degrees aside."""
    points = drifted(rng, np.eye(4), turn_rad=math.radians(5.0))
    held = points.keyframes[5].anchor.copy()
    assert revisit_candidate(points.map, points.keyframes[5]) is points.keyframes[1]
    assert reobserve(points.map, CAMERA, points.keyframes[5]) is None
    np.testing.assert_array_equal(points.keyframes[5].anchor, held)


def test_covisible_keyframes_are_skipped(rng):
    points = filled(rng, 300, 4)
    assert revisit_candidate(points.map, points.keyframes[0]) is None, "none is older"
    assert all(reobserve(points.map, CAMERA, keyframe) is None for keyframe in points.keyframes)
    check_map(points.map)


def test_a_place_with_few_inliers_is_not_matched(rng, drift):
    """Two keypoints in three were moved anywhere nearby: enough of the rest agree, but that is not the place."""
    points = drifted(rng, drift)
    last = points.keyframes[5]
    moved = rng.permutation(len(last.anchor))[: 2 * len(last.anchor) // 3]
    uv = last.features.uv.copy()
    uv[moved] += rng.uniform(-18, 18, (len(moved), 2)).astype(np.float32)
    last.features = replace(last.features, uv=uv)
    last.grid = KeypointGrid(uv)
    held = last.anchor.copy()
    assert reobserve(points.map, CAMERA, last) is None
    np.testing.assert_array_equal(last.anchor, held)


def test_a_keyframe_that_shares_the_anchors_of_its_neighbour_is_no_revisit(rng):
    """It is at the place of a keyframe with which it already shares anchors."""
    points = drifted(rng, np.eye(4))
    last, first = points.keyframes[5], points.keyframes[1]
    assert revisit_candidate(points.map, last) is first
    shared = np.flatnonzero((last.anchor >= 0) & (first.anchor >= 0))[:20]
    points.map.merge_anchors(last.anchor[shared], first.anchor[shared])
    assert revisit_candidate(points.map, last) is not first
