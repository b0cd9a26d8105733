"""The renderer's depth and geometry."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.views import look, random_pose
from edgeslam_torch.synthetic.house.world import Quad, Texture, World

CAMERA = Camera(320, 240, 260.0, 255.0, 161.3, 118.2)


def cast_rays(world, T_w_c, rays_c):
    """z-depth of rays with unit z by intersecting every quad, float64: the independent reference."""
    best = np.full(len(rays_c), np.inf)
    rays_w, origin = rays_c @ T_w_c[:3, :3].T, T_w_c[:3, 3]
    for quad in world.quads:
        n = np.cross(quad.v_w, quad.u_w)
        facing = rays_w @ n
        with np.errstate(divide="ignore", invalid="ignore"):
            z = (quad.origin_w - origin) @ n / facing
            hit = origin + z[:, None] * rays_w - quad.origin_w
            basis = np.stack([quad.u_w, quad.v_w], axis=1)
            st = hit @ np.linalg.pinv(basis).T
            ok = (z > 0.02) & ((facing < 0) | quad.two_sided) & (st >= 0).all(1) & (st <= 1).all(1)
        best = np.where(ok & (z < best), z, best)
    return best


def test_depth_equals_analytic_ray_cast(home):
    rng = np.random.default_rng(0)
    T_w_c = random_pose(rng, home)
    uv = rng.integers(0, [CAMERA.width, CAMERA.height], (600, 2))
    depth = render(home, CAMERA, T_w_c).depth_m
    truth = cast_rays(home, T_w_c, CAMERA.back_project(uv.astype(float), np.ones(len(uv))))
    np.testing.assert_allclose(depth[uv[:, 1], uv[:, 0]], truth, rtol=2e-6)


def test_a_sheet_straight_ahead_is_seen_from_its_front_or_from_both_sides():
    grey = Texture(np.full((8, 8, 3), 100, np.uint8))
    wall = Quad(np.array([3.0, 5.0, 5.0]), np.array([0.0, -10.0, 0.0]), np.array([0.0, 0.0, -10.0]), grey)
    view = render(World([wall]), CAMERA, look(np.zeros(3), 0.0))
    np.testing.assert_allclose(view.depth_m, 3.0, rtol=1e-6)
    assert np.all(view.image == 100) and np.all(view.quad_id == 0)
    behind = look(np.array([6.0, 0.0, 0.0]), np.pi)
    assert np.all(render(World([wall]), CAMERA, behind).quad_id == -1)
    assert np.all(render(World([replace(wall, two_sided=True)]), CAMERA, behind).quad_id == 0)


def test_texture_corner_is_drawn_where_it_projects():
    """A chequered wall seen obliquely: sub-pixel corners of the drawing against projected 3-D corners."""
    cells, px = 8, 64
    board = (np.indices((cells, cells)).sum(0) % 2 * 200 + 25).astype(np.uint8)
    image = cv2.cvtColor(np.kron(board, np.ones((px, px), np.uint8)), cv2.COLOR_GRAY2BGR)
    image = cv2.GaussianBlur(image, (0, 0), 2.0)  # smooth, so that the corner finder is better than the bound
    wall = Quad(np.array([3.0, 1.2, 2.2]), np.array([0.0, -2.4, 0.0]), np.array([0.0, 0.0, -2.4]), Texture(image))
    camera = Camera(640, 480, 500.0, 500.0, 321.4, 237.8)
    T_w_c = look(np.array([0.2, 0.9, 1.4]), -0.32, 0.1, 0.15)
    view = render(World([wall]), camera, T_w_c)
    k = np.arange(1, cells) / cells
    s, t = (g.ravel() for g in np.meshgrid(k, k))
    p_w = wall.origin_w + s[:, None] * wall.u_w + t[:, None] * wall.v_w
    uv = camera.project(se3.transform(se3.inverse(T_w_c), p_w))
    inside = np.all((uv > 15) & (uv < [624, 464]), axis=1)
    grey = cv2.cvtColor(view.image, cv2.COLOR_BGR2GRAY)
    found = uv[inside].astype(np.float32).reshape(-1, 1, 2).copy()
    cv2.cornerSubPix(grey, found, (6, 6), (-1, -1), (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4))
    error = np.linalg.norm(found[:, 0] - uv[inside], axis=1)
    assert inside.sum() > 25
    assert error.max() < 0.1, (error.max(), np.mean(found[:, 0] - uv[inside], axis=0))
    assert np.linalg.norm(np.mean(found[:, 0] - uv[inside], axis=0)) < 0.02  # no systematic half pixel


def test_quad_border_is_drawn_where_it_projects():
    """The blend at a vertical border puts the edge within 0.1 px (five samples a pixel)."""
    white, black = (Texture(np.full((8, 8, 3), g, np.uint8)) for g in (220, 20))
    far = Quad(np.array([4.0, 9.0, 9.0]), np.array([0.0, -18.0, 0.0]), np.array([0.0, 0.0, -18.0]), black)
    for y in (0.11, 0.2037, -0.3):
        near = Quad(np.array([2.0, y, 9.0]), np.array([0.0, -9.0, 0.0]), np.array([0.0, 0.0, -18.0]), white)
        T_w_c = look(np.zeros(3), 0.0, roll_rad=0.1)
        view = render(World([far, near]), CAMERA, T_w_c)
        ends = np.array([[2.0, y, 0.3], [2.0, y, -0.3]])
        a, b = CAMERA.project(se3.transform(se3.inverse(T_w_c), ends))
        rows = np.arange(int(min(a[1], b[1])) + 1, int(max(a[1], b[1])))
        covered = (view.image[rows, :, 0].astype(float) - 20) / 200
        edge = CAMERA.width - 0.5 - covered.sum(1)
        truth = a[0] + (rows - a[1]) / (b[1] - a[1]) * (b[0] - a[0])
        assert abs(np.mean(edge - truth)) < 0.05
        assert np.abs(edge - truth).max() < 0.4


def test_a_distorted_camera_and_an_empty_world_are_refused(home):
    with pytest.raises(ValueError, match="no distortion"):
        render(home, PRESETS["tum_fr1"], look(np.zeros(3), 0.0))
    with pytest.raises(ValueError, match="1 to 32767 quads"):
        World([])
