"""A frame's pose with the predicted one as a prior: a climb and a turn look alike on guessed depths."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.mapping.motion_terms import Vertical
from edgeslam_torch.optim.pose_only import PoseConfig
from edgeslam_torch.tracking.pose_prior import ExpectedPose, pose_on_anchors

CAMERA = Camera(640, 480, 460.0, 460.0, 320.0, 240.0)
LEVEL = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""``T_c_w`` of a level camera that looks along x, z up."""
CLIMB_M = 0.3


def climbed():
    T_w_c = se3.inverse(LEVEL)
    T_w_c[2, 3] += CLIMB_M
    return se3.inverse(T_w_c)


@pytest.fixture
def wall(rng):
    """Anchors of a rough wall 2 to 3 m away, all guessed to be 2.5 m away, and what a camera 0.3 m higher sees."""
    rays = np.column_stack([rng.uniform([-0.6, -0.2], [0.6, 0.5], (300, 2)), np.ones(300)])
    host_w = se3.inverse(LEVEL)
    true_w = se3.transform(host_w, rng.uniform(2.0, 3.0, (300, 1)) * rays)
    anchors = Anchors()
    words, colour = np.zeros((300, 4), np.uint64), np.zeros((300, 3), np.uint8)
    ids = anchors.add(se3.transform(host_w, 2.5 * rays), words, 0, True, colour)
    anchors.rest_on_prior(ids, 0, np.zeros(3), np.tile([0.4, 0.08], (300, 1)))
    return anchors, ids, CAMERA.project(se3.transform(climbed(), true_w)) + rng.normal(0, 0.5, (300, 2))


def solved(wall, sigma_rad):
    anchors, ids, uv = wall
    expected = ExpectedPose(LEVEL, np.diag([1.0] * 3 + [sigma_rad**-2] * 3))
    return pose_on_anchors(anchors, ids, uv, np.ones(len(ids)), LEVEL, CAMERA, expected, PoseConfig())


def tilt_deg(T_c_w):
    return math.degrees(math.acos(min(1.0, T_c_w[:3, 2] @ LEVEL[:3, 2])))


def test_a_prior_resolves_a_climb_on_predicted_depths(wall):
    held, loose = (solved(wall, math.radians(sigma_deg)).T_c_w for sigma_deg in (0.01, 30.0))
    assert tilt_deg(held) < 0.02
    assert se3.inverse(held)[2, 3] == pytest.approx(CLIMB_M, rel=0.2)
    assert tilt_deg(loose) > 0.1


def test_on_triangulated_anchors_no_motion_is_expected(wall):
    anchors, ids, uv = wall
    anchors.from_depth[ids] = False
    np.testing.assert_array_equal(*(solved(wall, sigma_rad).T_c_w for sigma_rad in (1e-4, 10.0)))


def leaning(rng, angle_rad):
    """A pose ``T_c_w`` that leans about a random horizontal axis, and what an upright camera there sees as up."""
    axis = rng.uniform(0.0, 2.0 * math.pi)
    upright = LEVEL @ se3.exp(np.array([1.0, -2.0, 0.5, 0.0, 0.0, rng.uniform(-3.0, 3.0)]))
    lean = upright[:3, :3] @ [math.cos(axis), math.sin(axis), 0.0]
    leans = se3.exp(np.concatenate([np.zeros(3), angle_rad * lean])) @ upright
    return leans, upright, Vertical(upright[:3, 2], np.array([0.0, 0.0, 1.0]), math.radians(2.0))


def test_a_levelled_prediction_keeps_its_centre_and_its_heading(rng):
    leans, upright, vertical = leaning(rng, 0.3)
    np.testing.assert_allclose(ExpectedPose(leans, np.zeros((6, 6)), vertical).prior(True).T_c_w, upright, atol=1e-9)


def test_of_a_levelled_prediction_the_vertical_is_known(rng):
    leans, _, vertical = leaning(rng, 0.3)
    up_c, motion = vertical.up_c, np.diag([4.0] * 3 + [9.0] * 3)
    expected = ExpectedPose(leans, motion, vertical)
    on_depths, triangulated = (expected.prior(rests).information for rests in (True, False))
    np.testing.assert_allclose(on_depths[:3], motion[:3])
    assert np.count_nonzero(triangulated[:3]) == np.count_nonzero(triangulated[:, :3]) == 0
    np.testing.assert_allclose(triangulated[3:, 3:] @ up_c, 0.0, atol=1e-6)
    across = np.cross(up_c, [0.3, -0.5, 0.8])
    assert np.dot(on_depths[3:, 3:] @ across, across) > 5.0 * np.dot(triangulated[3:, 3:] @ across, across) > 0.0


@pytest.mark.parametrize(
    ("lean_deg", "between_deg", "contradicts"), [(3.0, 0.0, True), (1.0, 0.0, False), (3.0, 2.0, False)]
)
def test_a_tilt_is_contradicted_beyond_what_attitude_may_err(rng, lean_deg, between_deg, contradicts):
    """By a degree it may err, and by what the drone leaned between two readings."""
    leans, upright, vertical = leaning(rng, math.radians(lean_deg))
    vertical = replace(vertical, systematic_rad=math.radians(between_deg))
    assert vertical.contradicts(leans) == contradicts
    assert not vertical.contradicts(upright)


def test_an_error_of_the_mount_counts_as_often_as_the_drone_turns(rng):
    leans, _, vertical = leaning(rng, 0.3)
    turned = ExpectedPose(leans, np.zeros((6, 6)), replace(vertical, systematic_rad=0.1))
    for rests in (True, False):
        assert np.abs(turned.prior(rests).information).max() <= 0.1**-2


def test_without_attitude_a_prediction_stays(rng):
    leans, _, _ = leaning(rng, 0.3)
    expected = ExpectedPose(leans, np.eye(6), None)
    np.testing.assert_array_equal(expected.prior(True).T_c_w, leans)
    np.testing.assert_array_equal(expected.prior(True).information, np.eye(6))
    np.testing.assert_array_equal(expected.prior(False).information, np.zeros((6, 6)))


def test_attitude_tells_a_climb_from_a_pitch_before_a_distant_wall(rng):
    """A strip of a wall 4 m away, whose depths err by 1 % together: the images alone turn a quarter of a climb of
    0.4 m into a pitch."""
    rays = np.column_stack([rng.uniform([-0.5, -0.06], [0.5, 0.06], (300, 2)), np.ones(300)])
    host_w = se3.inverse(LEVEL)
    true_w = se3.transform(host_w, 4.0 * rays)
    bent = 4.0 * (1.0 + 0.01 * np.sin(25.0 * rays[:, 1:2]))
    anchors = Anchors()
    words, colour = np.zeros((300, 4), np.uint64), np.zeros((300, 3), np.uint8)
    ids = anchors.add(se3.transform(host_w, bent * rays), words, 0, False, colour)
    T_w_c = host_w.copy()
    T_w_c[2, 3] += 0.4
    uv = CAMERA.project(se3.transform(se3.inverse(T_w_c), true_w)) + rng.normal(0, 0.5, (300, 2))
    vertical = Vertical(LEVEL[:3, 2], np.array([0.0, 0.0, 1.0]), math.radians(2.0))
    held, alone = (
        pose_on_anchors(
            anchors, ids, uv, np.ones(300), LEVEL, CAMERA, ExpectedPose(LEVEL, np.zeros((6, 6)), g), PoseConfig()
        ).T_c_w
        for g in (vertical, None)
    )
    assert tilt_deg(held) < 0.8 < 1.2 < tilt_deg(alone)
    assert se3.inverse(alone)[2, 3] < 0.3 < 0.35 < se3.inverse(held)[2, 3]


@pytest.mark.parametrize("held", [False, True])
def test_predicted_depths_that_are_upside_down_do_not_turn_a_climb_into_sinking(rng, held):
    """A wall that leans away is predicted to lean towards the camera: the images alone see a climb as sinking."""
    rays = np.column_stack([rng.uniform([-0.6, -0.4], [0.6, 0.4], (300, 2)), np.ones(300)])
    host_w, lean = se3.inverse(LEVEL), np.exp(0.75 * rays[:, 1:2])
    anchors = Anchors()
    words, colour = np.zeros((300, 4), np.uint64), np.zeros((300, 3), np.uint8)
    ids = anchors.add(se3.transform(host_w, 3.0 * rays / lean), words, 0, True, colour)
    anchors.rest_on_prior(ids, 0, np.zeros(3), np.tile([0.33, 0.07], (300, 1)))
    anchors.from_depth[ids] = not held  # a new map holds its vertical even where corners have been triangulated
    T_w_c = host_w.copy()
    T_w_c[2, 3] += 0.06
    uv = CAMERA.project(se3.transform(se3.inverse(T_w_c), se3.transform(host_w, 3.0 * lean * rays)))
    vertical = Vertical(LEVEL[:3, 2], np.array([0.0, 0.0, 1.0]), math.radians(2.8), held)
    alone, level = (
        pose_on_anchors(anchors, ids, uv, np.ones(300), LEVEL, CAMERA, expected, PoseConfig()).T_c_w
        for expected in (None, ExpectedPose(LEVEL, np.zeros((6, 6)), vertical))
    )
    assert se3.inverse(alone)[2, 3] < -0.02 and tilt_deg(alone) > 1.4
    assert se3.inverse(level)[2, 3] > 0.0 and tilt_deg(level) < 1.1
