"""A frame's pose against the map, with and without a prediction."""

from dataclasses import replace

import numpy as np
import pytest
from point_map import CAMERA, SCALE_FACTOR, filled, pose_error, small_motion

from edgeslam_torch.config import OrbConfig, TrackingConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.projection import project_anchors
from edgeslam_torch.tracking.pose_prior import ExpectedPose
from edgeslam_torch.tracking.relocaliser import match_keyframe
from edgeslam_torch.tracking.tracker import Tracker, make_view, median_parallax
from edgeslam_torch.types import FrameFeatures


@pytest.fixture
def points(rng):
    return filled(rng, 400, 6)


def tracker_of(points, **settings):
    return Tracker(points.map, CAMERA, OrbConfig(), TrackingConfig(**settings))


def view_of(points, view, rng, noise_px=0.0, wrong=0):
    """What a new frame at a keyframe's place sees; ``wrong`` keypoints have other points' descriptors."""
    seen = np.flatnonzero(points.world.visible[view])
    features = points.features(view, seen, noise_px * rng.normal(size=(len(seen), 2)))
    descriptors = features.descriptors.copy()
    descriptors[:wrong] = np.roll(descriptors[:wrong], 1, axis=0)
    return make_view(FrameFeatures(features.uv, features.octave, features.angle_rad, descriptors), SCALE_FACTOR)


def recent(points, view):
    keyframe = points.keyframes[view]
    return keyframe.anchor[keyframe.anchor >= 0]


def test_pose_of_a_noise_free_frame_is_exact(points, rng):
    predicted = small_motion(rng, 0.02, 0.01) @ points.world.T_c_w[3]
    track = tracker_of(points).track(view_of(points, 3, rng), predicted, recent(points, 2))
    assert pose_error(track.T_c_w, points.world.T_c_w[3])[0] < 1e-4
    assert track.inliers == track.matches
    seen = np.flatnonzero(points.world.visible[3])
    np.testing.assert_array_equal(points.map.anchors.words[track.anchor], view_of(points, 3, rng).words[track.keypoint])
    assert len(np.unique(track.keypoint)) == len(np.unique(track.anchor)) == track.inliers <= len(seen)


def test_half_a_pixel_of_noise_moves_the_pose_by_millimetres(points, rng):
    predicted = small_motion(rng, 0.02, 0.01) @ points.world.T_c_w[3]
    track = tracker_of(points).track(view_of(points, 3, rng, 0.5, 20), predicted, recent(points, 3))
    translation, rotation = pose_error(track.T_c_w, points.world.T_c_w[3])
    assert translation < 0.01
    assert rotation < 0.004
    sigma = np.sqrt(np.diag(track.covariance))
    assert (sigma > 1e-5).all()
    assert (sigma < 0.05).all()


@pytest.mark.parametrize("what", ["prediction", "no keypoints", "another place"])
def test_what_does_not_fit_gives_no_pose(points, rng, what):
    tracker, T_c_w, seen = tracker_of(points), points.world.T_c_w[3], view_of(points, 3, rng).features
    if what == "prediction":
        T_c_w = se3.exp(np.array([0, 0, 0, 0, 1.2, 0])) @ T_c_w
    elif what == "no keypoints":
        seen = FrameFeatures(seen.uv[:0], seen.octave[:0], seen.angle_rad[:0], seen.descriptors[:0])
    else:  # random descriptors at the right pixels
        bits = rng.integers(0, 256, seen.descriptors.shape, dtype=np.uint8)
        seen = FrameFeatures(seen.uv, seen.octave, seen.angle_rad, bits)
    view = make_view(seen, SCALE_FACTOR)
    assert tracker.track(view, T_c_w, recent(points, 3)) is None
    assert what == "prediction" or all(match_keyframe(tracker, view, keyframe) is None for keyframe in points.keyframes)


def test_anchors_that_are_seen_and_found_are_counted(points, rng):
    anchors = points.map.anchors
    visible, found = anchors.visible.copy(), anchors.found.copy()
    track = tracker_of(points).track(view_of(points, 3, rng), points.world.T_c_w[3], recent(points, 3))
    assert (anchors.found - found)[track.anchor].tolist() == [1] * track.inliers
    assert ((anchors.visible - visible) >= (anchors.found - found)).all()


def test_anchors_behind_outside_or_seen_from_behind_are_not_expected(points):
    ids = np.flatnonzero(points.map.anchors.alive)
    T = points.world.T_c_w[3]
    seen = project_anchors(points.map.anchors, ids, T, CAMERA, SCALE_FACTOR, 8)
    assert (seen.depth > 0).all()
    assert (seen.uv >= 0).all()
    assert (seen.uv < [640, 480]).all()
    p_c = se3.transform(T, points.map.anchors.p_w[seen.anchor])
    np.testing.assert_allclose(CAMERA.project(p_c), seen.uv, atol=1e-6)
    turned = se3.exp(np.array([0, 0, 0, 0, np.pi, 0])) @ T
    assert len(project_anchors(points.map.anchors, ids, turned, CAMERA, SCALE_FACTOR, 8).anchor) == 0
    behind_wall = T.copy()
    behind_wall[:3, 3] = T[:3, 3] - T[:3, :3] @ np.array([9.0, 0, 0])  # 9 m on along +x: all lies behind
    assert len(project_anchors(points.map.anchors, ids, behind_wall, CAMERA, SCALE_FACTOR, 8).anchor) == 0
    nothing = project_anchors(points.map.anchors, ids[:0], T, CAMERA, SCALE_FACTOR, 8)
    assert nothing.uv.shape == (0, 2)


def test_median_parallax_counts_from_where_the_camera_is():
    """A point 1 m right and 2 m ahead: straight ahead of a camera 1 m right, not of one 1 m left."""
    p_w = np.array([[1.0, 0.0, 2.0]] * 3)
    for x, angle in ((1.0, np.arctan2(1.0, 2.0)), (-1.0, np.arctan2(2.0, 2.0) - np.arctan2(1.0, 2.0))):
        T_c_w = np.eye(4)
        T_c_w[0, 3] = -x
        assert median_parallax(p_w, T_c_w, np.zeros(3)) == pytest.approx(angle)


def test_an_anchor_is_expected_at_the_level_of_its_distance(points):
    """Seen at level 0 from its reference distance; at 1 / 1.44 of that it fills level 2."""
    anchors = points.map.anchors
    ids = np.flatnonzero(anchors.alive)
    T = points.world.T_c_w[3]
    distance = np.linalg.norm(se3.transform(T, anchors.p_w[ids]), axis=1)
    for level, factor in ((0, 1.0), (2, SCALE_FACTOR**2), (5, SCALE_FACTOR**5)):
        anchors.max_distance[ids] = factor * distance
        seen = project_anchors(anchors, ids, T, CAMERA, SCALE_FACTOR, 8)
        assert len(seen.anchor) > 50
        assert (seen.octave == level).all()
    anchors.max_distance[ids] = distance / SCALE_FACTOR**4  # four levels beyond the coarsest of the detector: too far
    assert len(project_anchors(anchors, ids, T, CAMERA, SCALE_FACTOR, 8).anchor) == 0


@pytest.mark.parametrize(("off_deg", "expected"), [(0.0, True), (55.0, True), (65.0, False), (180.0, False)])
def test_an_anchor_is_expected_within_60_degrees_of_how_it_was_seen(points, off_deg, expected):
    anchors = points.map.anchors
    ids = np.flatnonzero(anchors.alive)
    T = points.world.T_c_w[3]
    ray = anchors.p_w[ids] - se3.inverse(T)[:3, 3]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    side = np.cross(ray, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.deg2rad(off_deg)
    anchors.normal[ids] = np.cos(angle) * ray + np.sin(angle) * side
    anchors.max_distance[ids] = np.linalg.norm(anchors.p_w[ids] - se3.inverse(T)[:3, 3], axis=1)
    assert (len(project_anchors(anchors, ids, T, CAMERA, SCALE_FACTOR, 8).anchor) > 50) == expected


def test_on_predicted_depths_the_motion_prior_constrains_the_pose(points, rng):
    """Every depth is a guess: images hardly tell a turn from a shift, and what accelerations allow has a say."""
    anchors = points.map.anchors
    ids = np.flatnonzero(anchors.alive)
    host = points.keyframes[3]
    anchors.from_depth[ids] = True
    z = se3.transform(host.T_c_w, anchors.p_w[ids])[:, 2]
    anchors.rest_on_prior(ids, host.id, host.centre_w, np.stack([1.0 / z, 0.5 / np.abs(z)], axis=1))
    T = points.world.T_c_w[3]
    sigma = np.array([5e-4] * 3 + [1e-2] * 3)
    expected = ExpectedPose(T, np.diag(sigma**-2))
    tracker, view = tracker_of(points), view_of(points, 3, rng, 0.5)
    shift = se3.exp(np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0])) @ T
    held, free = (tracker.track(view, shift, recent(points, 3), e) for e in (expected, None))
    assert np.sqrt(np.diag(held.covariance))[:3].max() <= 5.01e-4
    assert np.sqrt(np.diag(free.covariance))[:3].max() > 1.5e-3
    assert pose_error(held.T_c_w, points.world.T_c_w[3])[0] < 2e-3
    anchors.from_depth[ids] = False
    at_shift = replace(expected, T_c_w=shift)
    sure = tracker.track(view, shift, recent(points, 3), at_shift)
    assert pose_error(sure.T_c_w, points.world.T_c_w[3])[0] < 0.01, "triangulated points need no such help"
