"""Anchors whose depth rests on a prior."""

import numpy as np
import pytest
from point_map import CAMERA, PointMap

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.triangulation import bearings
from edgeslam_torch.mapping.prior_anchors import (
    add_on_prior,
    depth_priors,
    depth_slack_px,
    drop_redundant_priors,
    inverse_depth_with_prior,
    mostly_on_priors,
    prior_of,
)
from edgeslam_torch.mapping.refinement import Window, refine
from edgeslam_torch.optim.problem import LmConfig

POINTS = np.array([[0.3, -0.2, 2.0], [-0.5, 0.4, 3.0], [0.1, 0.1, 5.0]])


def seen_from(T_o_k, noise=0.0):
    """Rays in k, pixels in o, of `POINTS` given in k."""
    p_o = se3.transform(T_o_k, POINTS)
    return bearings(CAMERA.project(POINTS), CAMERA.K), CAMERA.project(p_o) + noise


@pytest.fixture
def points(rng):
    return PointMap(rng, 300, 4)


def on_priors(points, error, sigma_log=0.3):
    """The map's first keyframe as host of anchors whose priors are off by a factor; the others see them too."""
    for keyframe in points.keyframes:
        points.map.add_keyframe(keyframe)
    host = points.keyframes[0]
    depth = se3.transform(host.T_c_w, points.world.p_w[points.point_of[0]])[:, 2]
    prior = prior_of(depth * error, np.full(len(depth), sigma_log))
    colour = np.zeros((len(depth), 3), np.uint8)
    ids = add_on_prior(points.map, CAMERA, host, np.arange(len(depth)), prior[:, 0], prior, colour)
    for keyframe, seen in zip(points.keyframes[1:], points.point_of[1:], strict=True):
        common, mine, theirs = np.intersect1d(points.point_of[0], seen, return_indices=True)
        points.map.observe(keyframe, theirs, ids[mine])
    points.map.refresh_anchors(ids)
    return ids


# -- depth of a match under a prior ----------------------------------------------------------------------------------


def test_the_result_minimises_the_sum_of_both_costs():
    """One point, one pixel of parallax: compare with the minimum found by trying."""
    T = se3.exp(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0]))
    ray, uv = seen_from(T, noise=0.4)
    prior = prior_of(np.array([2.6, 3.0, 4.0]), np.full(3, 0.4))
    found, _ = inverse_depth_with_prior(ray, uv, np.ones(3), T, CAMERA, prior)
    for i in range(3):
        rho = np.linspace(0.3, 2.0, 20001) * prior[i, 0]
        p = ray[i] @ T[:3, :3].T + rho[:, None] * T[:3, 3]
        r = CAMERA.project(p) - uv[i]
        cost = (r**2).sum(1) + ((rho - prior[i, 0]) / prior[i, 1]) ** 2
        assert found[i, 0] == pytest.approx(rho[cost.argmin()], rel=1e-3)


def test_a_wrong_match_does_not_reproject():
    T = se3.exp(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0]))
    ray, uv = seen_from(T)
    uv[1] += [0.0, 12.0]  # across its epipolar line
    _, chi2 = inverse_depth_with_prior(ray, uv, np.ones(3), T, CAMERA, prior_of(POINTS[:, 2], np.full(3, 0.5)))
    assert chi2[1] > 100.0
    assert (chi2[[0, 2]] < 1e-6).all()


# -- in the window ---------------------------------------------------------------------------------------------------


def test_refinement_corrects_wrong_priors_with_parallax(points):
    ids = on_priors(points, error=1.15)
    seen = points.map.anchors.observations[ids] >= 3
    window = Window(points.keyframes[2:], points.keyframes[:2], points.map.anchors_seen_by(points.keyframes))
    result = refine(points.map, window, CAMERA, LmConfig(max_iterations=30))
    assert result.stop.converged
    alive = seen & points.map.anchors.alive[ids]
    truth = points.world.p_w[points.point_of[0]]
    error = np.linalg.norm(points.map.anchors.p_w[ids] - truth, axis=1)[alive]
    assert np.median(error) < 0.01
    assert alive.sum() > 50


def test_a_host_outside_the_window_constrains_its_anchors(points):
    ids = on_priors(points, error=1.0)
    keyframes = points.keyframes[1:]
    priors, hosts = depth_priors(points.map, ids, [k.id for k in keyframes])
    assert hosts == [points.keyframes[0].id]
    assert (priors.pose == len(keyframes)).all()
    np.testing.assert_allclose(priors.inverse_depth, points.map.anchors.prior[ids, 0])


def test_parallax_drops_the_prior_of_an_anchor(points):
    ids = on_priors(points, error=1.0)
    other = points.keyframes[3]
    drop_redundant_priors(points.map, points.keyframes[0], np.deg2rad(1.0))
    assert points.map.anchors.from_depth[ids].all(), "its own host sees no parallax"
    drop_redundant_priors(points.map, other, np.deg2rad(1.0))
    held = other.anchor[other.anchor >= 0]
    p = points.map.anchors.p_w[held]
    a, b = p - points.keyframes[0].centre_w, p - other.centre_w
    angle = np.arccos((a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1))
    np.testing.assert_array_equal(points.map.anchors.from_depth[held], angle <= np.deg2rad(1.0))
    assert (angle > np.deg2rad(1.0)).any()


# -- how an uncertain depth shows in the image -----------------------------------------------------------------------


def test_slack_is_what_a_depth_error_of_one_sigma_moves_the_pixel_by(points):
    ids = on_priors(points, error=1.0, sigma_log=0.5)
    T = points.world.T_c_w[2]
    slack = depth_slack_px(points.map.anchors, ids, T, CAMERA)
    p, origin = points.map.anchors.p_w[ids], points.keyframes[0].centre_w
    moved = origin + 1.0005 * (p - origin)  # a thousandth of a sigma, for the derivative
    expected = 1e3 * (CAMERA.project(se3.transform(T, moved)) - CAMERA.project(se3.transform(T, p)))
    front = se3.transform(T, p)[:, 2] > 0.5
    np.testing.assert_allclose(slack[front], expected[front], rtol=0.05, atol=0.01)


def test_triangulated_anchors_have_no_slack(points):
    anchor_of = points.fill()
    ids = anchor_of[anchor_of >= 0]
    assert depth_slack_px(points.map.anchors, ids, points.world.T_c_w[1], CAMERA) is None
    assert not mostly_on_priors(points.map.anchors, ids)
    points.map.anchors.from_depth[ids[: len(ids) // 2 + 1]] = True
    assert mostly_on_priors(points.map.anchors, ids)


def test_sigma_of_predicted_depth_is_at_least_half():
    """Whatever sigma it states: inverse depth 1 / z, and at least half of that for its standard deviation."""
    prior = prior_of(np.array([2.0, 4.0, 4.0]), np.array([0.05, 0.3, 0.8]))
    np.testing.assert_allclose(prior, [[0.5, 0.25], [0.25, 0.125], [0.25, 0.2]])
