"""A frame's pose with the drone's roll and pitch, against geometry: a climb and a turn look alike on guessed depths."""

import math

import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.optim.pose_only import PoseConfig
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.tracking.pose_prior import Attitude, Place, TrackingPrior, Vertical, levelled, pose_on_anchors

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


def test_attitude_gate_rejects_rotations_beyond_quantisation():
    told = Attitude(LEVEL[:3, :3], math.radians(1.0))
    assert not told.is_outlier(LEVEL) and not told.is_outlier(climbed())
    assert not told.is_outlier(tilted(3.9)) and not told.is_outlier(tilted(-3.9))
    assert told.is_outlier(tilted(4.1)) and told.is_outlier(tilted(-4.1))


def test_attitude_rotates_a_pose_about_its_centre():
    turned = Attitude(LEVEL[:3, :3], 0.0).applied_to(tilted(20.0, climbed()))
    np.testing.assert_allclose(turned, climbed(), atol=1e-12)


AXES = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""``R_w_m`` of a drone that was switched on facing right."""


def at(centre_m, doubt=0.05):
    """The place of a camera at ``(3,)`` in the map's axes."""
    return Place(AXES, AXES @ centre_m, np.full(3, doubt))


def seen_from(T_c_w, p_w, mapped_w, rng):
    """What a camera sees of points ``(N, 3)``, and the anchors ``(N, 3)`` that the map has of them."""
    anchors = Anchors()
    n = len(p_w)
    ids = anchors.add(mapped_w, np.zeros((n, 4), np.uint64), 0, False, np.zeros((n, 3), np.uint8))
    return anchors, ids, CAMERA.project(se3.transform(T_c_w, p_w)) + rng.normal(0, 0.3, (n, 2))


@pytest.fixture
def papered(rng):
    """A wall 3.7 m away that fills little of the image, mapped as leaning by 5 degrees, from a camera 0.3 m higher."""
    y, z = rng.uniform([-1.4, -1.0], [1.4, 0.9], (300, 2)).T
    p_w = np.column_stack([np.full(300, 3.7), y, z])
    mapped = p_w + np.column_stack([math.tan(math.radians(5.0)) * z, np.zeros((300, 2))])
    return seen_from(climbed(), p_w, mapped, rng)


def before_the_wall(papered, place):
    anchors, ids, uv = papered
    expected = TrackingPrior(PosePrior(0, LEVEL, np.eye(6)), None, place)
    return pose_on_anchors(anchors, ids, uv, np.full(len(ids), 0.5), LEVEL, CAMERA, expected, PoseConfig())


def centre_of(found):
    return se3.inverse(found.T_c_w)[:3, 3]


def test_position_resolves_a_climb_before_a_tilted_wall(papered):
    true = np.array([0.0, 0.0, CLIMB_M])
    free = centre_of(before_the_wall(papered, None))
    assert abs(free[2] - CLIMB_M) > 0.1
    constrained = centre_of(before_the_wall(papered, at(true)))
    np.testing.assert_allclose(np.abs(constrained - true).max(), 0.05, atol=0.005)
    np.testing.assert_array_equal(centre_of(before_the_wall(papered, at(free))), free)


def test_a_pose_constrained_by_position_has_its_uncertainty(papered):
    """The images say something else: along the axes that are held its sigma is the doubt, and no other changes."""
    free = before_the_wall(papered, None)
    place = at(np.array([0.0, 0.0, CLIMB_M]))
    constrained = before_the_wall(papered, place)
    left = place.beyond(free.T_c_w) != 0
    to_axes = AXES @ free.T_c_w[:3, :3].T
    added = to_axes @ (constrained.covariance - free.covariance)[:3, :3] @ to_axes.T
    np.testing.assert_allclose(added, np.diag(np.where(left, 0.05**2, 0.0)), atol=1e-12)
    assert left.any() and not left.all()
    np.testing.assert_array_equal(constrained.covariance[3:], free.covariance[3:])


def test_a_failed_solution_is_not_constrained(papered):
    anchors, ids, uv = papered
    expected = TrackingPrior(PosePrior(0, LEVEL, np.eye(6)), None, at(np.array([0.0, 0.0, CLIMB_M])))
    few = slice(0, 4)
    found = pose_on_anchors(anchors, ids[few], uv[few], np.ones(4), LEVEL, CAMERA, expected, PoseConfig())
    assert not found.inliers.any()
    np.testing.assert_array_equal(found.T_c_w, LEVEL)


def test_a_position_contradicted_by_images_is_ignored(rng):
    p_w = rng.uniform([1.5, -2.0, -1.0], [6.0, 2.0, 1.0], (300, 3))
    anchors, ids, uv = seen_from(climbed(), p_w, p_w, rng)
    lie = TrackingPrior(PosePrior(0, LEVEL, np.eye(6)), None, at(np.array([0.0, 0.0, -0.4])))
    found = pose_on_anchors(anchors, ids, uv, np.ones(len(ids)), LEVEL, CAMERA, lie, PoseConfig())
    np.testing.assert_allclose(se3.inverse(found.T_c_w)[:3, 3], [0.0, 0.0, CLIMB_M], atol=0.02)


def test_distance_from_the_interval_is_measured_along_its_axes():
    place = Place(AXES, np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]))
    inside, beyond = (AXES.T @ np.array(c) for c in ([1.09, 1.81, 3.0], [1.5, 1.5, 3.31]))
    T = np.eye(4)
    T[:3, :3] = se3.exp(np.array([0.0, 0.0, 0.0, 0.4, -0.2, 0.9]))[:3, :3]

    def from_centre(c):
        return np.block([[T[:3, :3], -T[:3, :3] @ c[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])

    np.testing.assert_array_equal(place.beyond(from_centre(inside)), np.zeros(3))
    np.testing.assert_allclose(place.beyond(from_centre(beyond)), [0.4, -0.3, 0.01], atol=1e-12)
    prior = place.constrained(from_centre(beyond), PosePrior(0, np.eye(4), np.zeros((6, 6))))
    np.testing.assert_allclose(AXES @ se3.inverse(prior.T_c_w)[:3, 3], [1.1, 1.8, 3.3], atol=1e-12)
    np.testing.assert_allclose(prior.T_c_w[:3, :3], T[:3, :3], atol=1e-12)


def test_only_axes_outside_the_interval_are_constrained():
    place = Place(AXES, np.zeros(3), np.full(3, 0.1))
    T = np.block([[np.eye(3), -(AXES.T @ [0.0, 0.0, 0.5])[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    information = place.constrained(T, PosePrior(0, np.eye(4), np.zeros((6, 6)))).information
    along, across = AXES[2], AXES[0]
    assert along @ information[:3, :3] @ along == pytest.approx(1.0 / 0.002**2)
    assert across @ information[:3, :3] @ across == pytest.approx(0.0, abs=1e-6)
    assert not information[3:].any()
