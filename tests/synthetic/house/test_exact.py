"""Ground-truth edges and junctions of a view."""

import numpy as np
import pytest

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.exact import depth_discontinuities, is_visible, visible_edges, visible_junctions
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.rooms import look
from edgeslam_torch.synthetic.house.world import Quad, Texture, World

CAMERA = Camera(320, 240, 260.0, 260.0, 159.5, 119.5)


def sheet(x: float, y: tuple[float, float], z: tuple[float, float], grey: int) -> Quad:
    """Upright sheet at ``x`` that faces a camera at the origin looking along +x."""
    texture = Texture(np.full((8, 8, 3), grey, np.uint8))
    origin = np.array([x, y[1], z[1]])
    return Quad(origin, np.array([0.0, y[0] - y[1], 0.0]), np.array([0.0, 0.0, z[0] - z[1]]), texture)


@pytest.fixture
def two_sheets() -> World:
    return World([sheet(4.0, (-8, 8), (-8, 8), 60), sheet(2.0, (-0.5, 0.4), (-0.3, 0.35), 200)])


def test_visible_edges_lie_on_the_border_of_the_near_sheet(two_sheets: World) -> None:
    T_w_c = look(np.zeros(3), 0.0)
    view = render(two_sheets, CAMERA, T_w_c)
    edges = visible_edges(two_sheets, CAMERA, T_w_c, view)
    assert len(edges.uv) > 100
    np.testing.assert_allclose(edges.depth_m, 2.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(edges.direction_uv, axis=1), 1.0, atol=1e-9)
    p_c = se3.transform(se3.inverse(T_w_c), edges.p_w)
    np.testing.assert_allclose(CAMERA.project(p_c), edges.uv, atol=1e-9)
    jump = depth_discontinuities(view)
    column, row = np.rint(edges.uv).astype(int).T
    near = [jump[r - 1 : r + 2, c - 1 : c + 2].any() for r, c in zip(row, column, strict=True)]
    assert all(near)
    np.testing.assert_allclose(view.depth_m[jump], 2.0, rtol=1e-6)


def test_junctions_have_right_angles_and_both_arms_in_sight(two_sheets: World) -> None:
    T_w_c = look(np.array([0.0, 0.1, -0.05]), 0.1, 0.05)
    view = render(two_sheets, CAMERA, T_w_c)
    corners = visible_junctions(two_sheets, CAMERA, T_w_c, view)
    assert len(corners.uv) == 4
    a, b = corners.arm_a_w - corners.p_w, corners.arm_b_w - corners.p_w
    np.testing.assert_allclose(np.sum(a * b, axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(a, axis=1), 0.1)
    np.testing.assert_allclose(corners.uv, CAMERA.project(se3.transform(se3.inverse(T_w_c), corners.p_w)))


def test_point_behind_a_sheet_is_hidden(two_sheets: World) -> None:
    T_w_c = look(np.zeros(3), 0.0)
    view = render(two_sheets, CAMERA, T_w_c)
    p_w = np.array([[4.0, 0.0, 0.0], [4.0, 1.5, 0.0], [2.0, 0.0, 0.0], [-4.0, 0.0, 0.0], [4.0, 5.0, 0.0]])
    assert is_visible(CAMERA, T_w_c, view, p_w).tolist() == [False, True, True, False, False]


def test_world_knows_floor_clearance_and_surface(two_sheets: World) -> None:
    np.testing.assert_allclose(two_sheets.distance_to_surface(np.array([[1.0, 0.0, 0.0], [3.5, 2.0, 0.0]])), [1.0, 0.5])
    flat = Texture(np.full((8, 8, 3), 9, np.uint8))
    table = Quad(np.array([0.0, 1.0, 0.7]), np.array([1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0]), flat)
    floor = Quad(np.array([-3.0, 3.0, 0.0]), np.array([6.0, 0.0, 0.0]), np.array([0.0, -6.0, 0.0]), flat)
    world = World([floor, table])
    below = world.floor_below(np.array([[0.5, 0.5, 1.2], [0.5, 0.5, 0.4], [2.0, 2.0, 1.2]]))
    np.testing.assert_allclose(below, [0.7, 0.0, 0.0])
