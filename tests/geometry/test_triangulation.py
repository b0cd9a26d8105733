"""Points from two views."""

import numpy as np
import pytest
from point_world import box_room

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.triangulation import bearings, parallax, triangulate


@pytest.mark.parametrize("j", [1, 4])
def test_noise_free_points_come_back_exactly(rng, j):
    world = box_room(rng, 200)
    T_j_i = world.T_c_w[j] @ se3.inverse(world.T_c_w[0])
    rays = [bearings(world.uv[k], world.K) for k in (0, j)]
    p_c = triangulate(*rays, T_j_i)
    truth = se3.transform(world.T_c_w[0], world.p_w)
    # A point near the baseline has next to no parallax and amplifies rounding.
    np.testing.assert_allclose(p_c, truth, atol=1e-7)


def test_noise_moves_points_by_what_their_parallax_allows(rng):
    world = box_room(rng, 400)
    T_j_i = world.T_c_w[4] @ se3.inverse(world.T_c_w[0])
    uv = [world.uv[k] + rng.normal(0.0, 0.5, (400, 2)) for k in (0, 4)]
    p_c = triangulate(bearings(uv[0], world.K), bearings(uv[1], world.K), T_j_i)
    truth = se3.transform(world.T_c_w[0], world.p_w)
    angle = parallax(bearings(world.uv[0], world.K), bearings(world.uv[4], world.K), T_j_i[:3, :3])
    seen = world.visible[0] & world.visible[4] & (angle > np.deg2rad(5))
    sigma = np.linalg.norm(truth, axis=1) * np.sqrt(2) * 0.5 / world.K[0, 0] / np.sin(angle)
    assert seen.sum() > 50
    assert np.median((np.linalg.norm(p_c - truth, axis=1) / sigma)[seen]) < 1.5


def test_parallel_rays_give_nan():
    T_j_i = np.eye(4)
    T_j_i[0, 3] = -1.0
    ray = np.array([[0.1, 0.0, 1.0]])
    assert not np.isfinite(triangulate(ray, ray, T_j_i)).any()
    assert not np.isfinite(triangulate(ray, ray, np.eye(4))).any()  # no baseline


def test_point_behind_comes_back_with_negative_depth():
    T_j_i = np.eye(4)
    T_j_i[0, 3] = -1.0
    p = triangulate(np.array([[0.0, 0.0, 1.0]]), np.array([[0.5, 0.0, 1.0]]), T_j_i)  # rays that part
    assert p[0, 2] < 0


def test_parallax_ignores_rotation(rng):
    R = se3.exp(np.array([0, 0, 0, 0.2, -0.1, 0.3]))[:3, :3]
    ray_i = bearings(rng.uniform(0, 480, (10, 2)), np.diag([500.0, 500.0, 1.0]))
    assert parallax(ray_i, ray_i @ R.T, R).max() < 1e-7
    turned = se3.exp(np.array([0, 0, 0, 0, 0.1, 0]))[:3, :3]
    np.testing.assert_allclose(parallax(np.array([[0.0, 0, 1]]), np.array([[0.0, 0, 1]]), turned), 0.1)
