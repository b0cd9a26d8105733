"""Poses from edges: exact surfaces, measured edges, and frames without usable points."""

import cv2
import numpy as np
import pytest
from point_map import edge_points, small_motion
from rendered import CAMERA, film, sideways, stairs_world

from edgeslam_torch.config import EdgeConfig, OrbConfig
from edgeslam_torch.frontend.edges import extract_edges
from edgeslam_torch.frontend.orb import OrbExtractor
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.optim.problem import PosePrior
from edgeslam_torch.tracking.edge_tracker import EdgeImage, EdgeTracker, PointsInFrame

STRIPES = np.repeat((np.arange(320) // 20 % 2 * 120 + 60)[None].astype(np.uint8), 240, axis=0)


def tracker_on(image, depth_m, T_w_c):
    """A map of one keyframe with the edges of an image at their true depths."""
    grey = image if image.ndim == 2 else image[..., 1].copy()
    slam_map = SlamMap(1.2)
    keyframe = make_keyframe(0, 0, 0.0, se3.inverse(T_w_c), OrbExtractor(OrbConfig(), CAMERA)(grey))
    slam_map.add_keyframe(keyframe)
    edges = EdgeMap(slam_map, CAMERA, EdgeConfig())
    found = extract_edges(grey, 40.0, 100.0, 4000)
    u, v = found.uv.astype(int).T
    z = cv2.erode(depth_m, np.ones((5, 5)))[v, u].astype(np.float64)  # an outline belongs to what is nearer
    own = {"uv": found.uv, "normal": found.normal, "observations": np.full(len(z), 2, np.int32)}
    edges.hosts.append(edge_points(0, CAMERA.back_project(found.uv, z), CAMERA, **own))
    return EdgeTracker(slam_map, edges, CAMERA)


@pytest.fixture(scope="module")
def flight():
    return film(stairs_world(), CAMERA, sideways(4, 0.03, turn_rad=0.01))


@pytest.fixture(scope="module")
def tracker(flight):
    return tracker_on(flight.frames[0].image, flight.depth_m[0], flight.T_w_c[0])


def grey_of(flight, index):
    return flight.frames[index].image[..., 1].copy()


def off(T_c_w, T_w_c_true):
    error = se3.log(T_c_w @ T_w_c_true)
    return np.linalg.norm(error[:3]), np.rad2deg(np.linalg.norm(error[3:]))


@pytest.mark.parametrize("index", [1, 2, 3])
def test_edges_alone_find_the_pose(flight, tracker, rng, index):
    """A centimetre and half a degree off, some 4 px: found to 1 % of the depth, and said to be fixed."""
    start = small_motion(rng, 0.005, 0.005) @ se3.inverse(flight.T_w_c[index])
    pose = tracker.refine(grey_of(flight, index), start)
    shift, turn = off(pose.T_c_w, flight.T_w_c[index])
    assert shift < 0.03
    assert turn < 0.2
    assert pose.is_fixed
    assert pose.edges > 300


def test_disabled_tracking_uses_no_edges(flight, tracker):
    off = EdgeTracker(tracker.map, tracker.edges, tracker.camera, enabled=False)
    assert off.refine(grey_of(flight, 1), se3.inverse(flight.T_w_c[1])) is None


def test_a_wrong_pose_from_a_distant_prediction_is_rejected(flight, tracker, rng):
    """Up to 30 px: edges meet the wrong neighbours, in some starts; no such pose counts as fixed."""
    found = 0
    for index in (1, 2, 3) * 6:
        pose = tracker.refine(grey_of(flight, index), small_motion(rng, 0.02, 0.02) @ se3.inverse(flight.T_w_c[index]))
        shift, turn = (np.inf, np.inf) if pose is None else off(pose.T_c_w, flight.T_w_c[index])
        right = shift < 0.03 and turn < 0.6
        found += right
        assert right or pose is None or not pose.is_fixed
    assert 3 <= found < 18, "some starts are too far off, some are not"


def test_sigma_covers_the_error(flight, tracker, rng):
    chi2 = []
    for index in (1, 2, 3) * 3:
        start = small_motion(rng, 0.01, 0.005) @ se3.inverse(flight.T_w_c[index])
        pose = tracker.refine(grey_of(flight, index), start)
        error = se3.log(pose.T_c_w @ flight.T_w_c[index])
        chi2.append(error @ np.linalg.solve(pose.covariance, error))
    assert np.median(chi2) < 12.6  # chi-square, six degrees of freedom, 95 %


def test_parallel_lines_do_not_constrain_a_pose():
    tracker = tracker_on(STRIPES, np.full((240, 320), 2.0), np.eye(4))
    pose = tracker.refine(STRIPES, np.eye(4))
    assert pose.edges > 500
    assert not pose.is_fixed


def test_a_prediction_is_no_measurement():
    """Before parallel lines it is all that fixes the pose; where edges fix it, it takes no part in their covariance."""
    expected = PosePrior(0, np.eye(4), np.diag([0.02**-2.0] * 3 + [0.02**-2.0] * 3))
    pose = tracker_on(STRIPES, np.full((240, 320), 2.0), np.eye(4)).refine(STRIPES, np.eye(4), None, expected)
    assert pose.edges > 500
    assert not pose.is_fixed


def test_an_image_of_another_place_is_rejected(tracker, flight, rng):
    """Some edges meet others by chance, a tenth to a fifth of those in view; noise has more to meet."""
    noise = rng.integers(0, 255, (240, 320), dtype=np.uint8)
    other = film(stairs_world(99), CAMERA, sideways(1, 0.0)).frames[0].image[..., 1].copy()
    for start in (np.eye(4), small_motion(rng, 0.02, 0.02)):
        for image in (noise, other):
            pose = tracker.refine(image, start @ se3.inverse(flight.T_w_c[0]))
            assert pose.in_view > 500
            assert not pose.is_fixed


@pytest.mark.parametrize("grey", [0, 255])
def test_a_blank_image_and_an_empty_map_give_nothing(tracker, flight, grey):
    T_c_w = se3.inverse(flight.T_w_c[0])
    assert tracker.refine(np.full((240, 320), grey, np.uint8), T_c_w) is None
    empty = SlamMap(1.2)
    assert EdgeTracker(empty, EdgeMap(empty, CAMERA, EdgeConfig()), CAMERA).refine(STRIPES, T_c_w) is None


def test_edges_help_few_and_noisy_points(flight, tracker, rng):
    """Ten points with 3 px of noise alone are centimetres off; edges beside them are not."""
    truth = se3.inverse(flight.T_w_c[2])
    uv = rng.uniform((20, 20), (300, 220), (10, 2))
    z = flight.depth_m[2][uv[:, 1].astype(int), uv[:, 0].astype(int)]
    p_w = se3.transform(flight.T_w_c[2], CAMERA.back_project(uv, z))
    points = PointsInFrame(p_w, uv + rng.normal(0, 3.0, (10, 2)), np.full(10, 1 / 3), np.zeros((10, 2)))
    pose = tracker.refine(grey_of(flight, 2), small_motion(rng, 0.01, 0.005) @ truth, points)
    assert off(pose.T_c_w, flight.T_w_c[2])[0] < 0.02
    assert pose.points.shape == (10,)


def test_nearest_edge_is_the_nearest(rng):
    """Against trying every edge pixel."""
    image = EdgeImage.of(STRIPES, 40.0, 100.0)
    uv = rng.uniform(5, 230, (50, 2))
    pixel, normal, near = image.nearest(uv, 6.0)
    distance = np.linalg.norm(image.pixel[None] - np.rint(uv)[:, None], axis=2)
    np.testing.assert_allclose(np.linalg.norm(pixel - np.rint(uv), axis=1), distance.min(1), atol=0.5)
    np.testing.assert_allclose(np.abs(normal[:, 0]), 1.0, atol=1e-6)  # across vertical stripes
    assert (near == (image.distance[np.rint(uv[:, 1]).astype(int), np.rint(uv[:, 0]).astype(int)] <= 6.0)).all()
