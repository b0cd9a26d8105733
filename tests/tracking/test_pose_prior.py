"""A frame's pose with the predicted one as a prior: a climb and a turn look alike on guessed depths."""

import math

import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.optim.pose_only import PoseConfig
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.tracking.pose_prior import pose_on_anchors

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
    level = PosePrior(0, LEVEL, np.diag([1.0] * 3 + [sigma_rad**-2] * 3))
    return pose_on_anchors(anchors, ids, uv, np.ones(len(ids)), LEVEL, CAMERA, level, PoseConfig())


def tilt_deg(T_c_w):
    return math.degrees(math.acos(min(1.0, T_c_w[:3, 2] @ LEVEL[:3, 2])))


def test_a_prior_resolves_a_climb_on_predicted_depths(wall):
    held, loose = (solved(wall, math.radians(sigma_deg)).T_c_w for sigma_deg in (0.01, 30.0))
    assert tilt_deg(held) < 0.02
    assert se3.inverse(held)[2, 3] == pytest.approx(CLIMB_M, rel=0.2)
    assert tilt_deg(loose) > 0.1


def test_triangulated_anchors_need_no_prior(wall):
    anchors, ids, uv = wall
    anchors.from_depth[ids] = False
    np.testing.assert_array_equal(*(solved(wall, sigma_rad).T_c_w for sigma_rad in (1e-4, 10.0)))
