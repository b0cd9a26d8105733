"""A frame's pose with the drone's roll and pitch, against geometry: a climb and a turn look alike on guessed depths."""

import math

import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.optim.pose_only import PoseConfig
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.tracking.pose_prior import TrackingPrior, Vertical, levelled, pose_on_anchors

CAMERA = Camera(640, 480, 460.0, 460.0, 320.0, 240.0)
LEVEL = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""``T_c_w`` of a level camera that looks along x, z up."""
CLIMB_M = 0.3


def tilted(degrees, T_c_w=LEVEL):
    return se3.exp(np.array([0.0, 0.0, 0.0, math.radians(degrees), 0.0, 0.0])) @ T_c_w


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


def solved(wall, vertical):
    anchors, ids, uv = wall
    loose = TrackingPrior(PosePrior(0, LEVEL, np.diag([1.0] * 3 + [100.0] * 3)), vertical)
    return pose_on_anchors(anchors, ids, uv, np.ones(len(ids)), LEVEL, CAMERA, loose, PoseConfig())


def tilt_deg(T_c_w):
    return math.degrees(math.acos(min(1.0, T_c_w[:3, 2] @ LEVEL[:3, 2])))


def test_attitude_resolves_a_climb_on_predicted_depths(wall):
    upright = solved(wall, Vertical(LEVEL[:3, 2], 0.0)).T_c_w
    assert tilt_deg(upright) < 0.02
    assert se3.inverse(upright)[2, 3] == pytest.approx(CLIMB_M, rel=0.2)


def test_a_constrained_pose_keeps_the_covariance_of_its_image(wall):
    constrained, free = solved(wall, Vertical(LEVEL[:3, 2], 0.0)), solved(wall, None)
    assert not np.allclose(constrained.T_c_w, free.T_c_w)
    np.testing.assert_array_equal(constrained.covariance, free.covariance)


def test_a_vertical_contradicted_by_images_is_ignored(wall):
    wrong = Vertical(tilted(25.0)[:3, 2], 0.0)
    np.testing.assert_allclose(solved(wall, wrong).T_c_w, solved(wall, None).T_c_w)


def test_a_fast_rotation_weakens_the_vertical(wall):
    off = tilted(0.7)[:3, 2]
    constrained, doubtful = (solved(wall, Vertical(off, doubt)).T_c_w for doubt in (0.0, math.radians(20.0)))
    free = solved(wall, None).T_c_w
    assert tilt_deg(constrained) == pytest.approx(0.7, abs=0.05)
    assert abs(tilt_deg(doubtful) - tilt_deg(free)) < 0.1


def test_levelling_keeps_the_centre_and_the_heading():
    T = tilted(-7.0, climbed())
    prior = levelled(PosePrior(0, T, np.eye(6)), Vertical(LEVEL[:3, 2], 0.0))
    np.testing.assert_allclose(prior.T_c_w, climbed(), atol=1e-12)
    about, across = LEVEL[:3, 2], np.array([0.0, 0.0, 1.0])
    assert about @ prior.information[3:, 3:] @ about == pytest.approx(1.0)
    assert across @ prior.information[3:, 3:] @ across > 1e8
