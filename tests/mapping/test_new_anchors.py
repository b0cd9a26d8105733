"""Anchors from the unmatched keypoints of two keyframes."""

import numpy as np
import pytest
from point_map import CAMERA, SCALE_FACTOR, PointMap

from edgeslam_torch.frontend.matching import Matches
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.mapping.new_anchors import epipolar_matches, triangulate_matches
from edgeslam_torch.types import FrameFeatures


@pytest.fixture
def points(rng):
    return PointMap(rng, 300, 3)


def matched(points, prior_depth, sigma_log=0.35):
    a, b = points.keyframes[0], points.keyframes[1]
    sigma = np.full(len(prior_depth), sigma_log)
    return epipolar_matches(a, b, CAMERA, prior_depth, sigma, SCALE_FACTOR)


def triangulated(points, matches, min_parallax_deg=1.0):
    a, b = points.keyframes[0], points.keyframes[1]
    return triangulate_matches(a, b, matches, CAMERA, SCALE_FACTOR, np.deg2rad(min_parallax_deg))


def test_matches_are_right_and_nearly_complete(points, rng):
    prior = points.depths(0) * np.exp(rng.normal(0, 0.2, len(points.point_of[0])))
    matches = matched(points, prior)
    np.testing.assert_array_equal(points.point_of[0][matches.query], points.point_of[1][matches.train])
    common = len(np.intersect1d(points.point_of[0], points.point_of[1]))
    # Segments longer than the search reaches (0.6 m baseline, points at 1 m) cost some.
    assert len(matches) > 0.7 * common


def test_a_wrong_prior_gives_no_wrong_matches(points):
    matches = matched(points, 20.0 * points.depths(0), 0.1)
    assert len(matches) < 0.05 * len(points.point_of[0])


def test_keypoints_with_an_anchor_are_skipped(points):
    points.fill()
    assert len(matched(points, points.depths(0))) == 0


def test_triangulated_points_are_exact(points):
    matches = matched(points, points.depths(0))
    p_w, sigma, used = triangulated(points, matches)
    truth = points.world.p_w[points.point_of[0][matches.query[used]]]
    np.testing.assert_allclose(p_w, truth, atol=2e-3)  # float32 pixels: 3e-5 px over little parallax
    assert len(used) > 0.6 * len(matches)
    assert (sigma > 0).all()
    assert np.isfinite(sigma).all()


def test_sigma_along_the_ray_matches_the_noise(rng):
    points = PointMap(rng, 2000, 3, noise_px=1.0)
    matches = matched(points, points.depths(0))
    p_w, sigma, used = triangulated(points, matches)
    truth = points.world.p_w[points.point_of[0][matches.query[used]]]
    ratio = np.linalg.norm(p_w - truth, axis=1) / sigma
    # One pixel of noise in both images along and across; checks on reprojection cut the tails.
    assert 0.4 < np.median(ratio) < 1.6


def test_wrong_pairs_do_not_triangulate(points, rng):
    common = np.intersect1d(points.point_of[0], points.point_of[1])
    where = [{p: i for i, p in enumerate(points.point_of[v])} for v in (0, 1)]
    query = np.array([where[0][p] for p in common])
    train = np.roll([where[1][p] for p in common], 7)
    _, _, used = triangulated(points, Matches(query, train, np.zeros(len(query), int)))
    assert len(used) < 0.05 * len(query)


def test_too_little_parallax_is_rejected(points):
    matches = matched(points, points.depths(0))
    assert len(triangulated(points, matches, 60.0)[2]) == 0


def test_a_level_that_contradicts_the_distance_is_rejected(points):
    matches = matched(points, points.depths(0))
    points.keyframes[1].features.octave[:] = 6
    assert len(triangulated(points, matches)[2]) == 0


def test_a_similar_keypoint_off_the_epipolar_line_is_not_matched(points, rng):
    """Six pixels beside every keypoint sits one with the very descriptor; the right one differs in 20 bits."""
    a, b = points.keyframes[0], points.keyframes[1]
    T = b.T_c_w @ se3.inverse(a.T_c_w)
    depth = points.depths(0)
    common, at_a, at_b = np.intersect1d(points.point_of[0], points.point_of[1], return_indices=True)
    p = CAMERA.back_project(a.features.uv[at_a], depth[at_a])
    along = CAMERA.project(se3.transform(T, 1.01 * p)) - CAMERA.project(se3.transform(T, p))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    twin_uv = b.features.uv[at_b] + 6.0 * np.stack([-along[:, 1], along[:, 0]], axis=1)
    bits = b.features.descriptors[at_b].copy()
    for row in bits:
        row[rng.permutation(32)[:20]] ^= 1
    n = len(common)
    uv = np.concatenate([b.features.uv[at_b], twin_uv]).astype(np.float32)
    descriptors = np.concatenate([bits, b.features.descriptors[at_b]])
    none = np.zeros(2 * n, np.int32)
    features = FrameFeatures(uv, none, none.astype(np.float32), descriptors)
    twins = make_keyframe(1, 10, 1.0, b.T_c_w, features)
    sigma = np.full(len(depth), 0.05)
    found = epipolar_matches(a, twins, CAMERA, depth, sigma, SCALE_FACTOR)
    right = dict(zip(at_a.tolist(), range(n), strict=True))
    chosen = [right[q] == t for q, t in zip(found.query.tolist(), found.train.tolist(), strict=True) if t < 2 * n]
    assert len(chosen) > 0.7 * n
    assert np.mean(chosen) > 0.95
