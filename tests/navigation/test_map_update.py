"""Stored positions follow the nearest view."""

import numpy as np
import pytest

from edgeslam_torch.navigation.map_update import MapUpdate, moves


def pose(x, y, z=1.0, yaw=0.0):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = [x, y, z]
    return T


BEFORE = np.array([pose(0.0, 0.0), pose(4.0, 0.0)])
AFTER = np.array([pose(0.0, 0.0), pose(4.0, 1.0, 1.2, np.pi / 2)])


def test_a_point_turns_and_grows_about_its_view():
    """The second view moved by (0, 1, 0.2) and turned square to the left: what was 1 m before it is 2 m to its left."""
    update = MapUpdate(BEFORE, AFTER, 2.0)
    points = update.points(np.array([[0.5, 0.0, 1.0], [5.0, 0.0, 1.5]]))
    assert points == pytest.approx(np.array([[1.0, 0.0, 1.0], [4.0, 3.0, 2.2]]))


def test_places_move_as_points_at_the_height_of_their_views():
    assert MapUpdate(BEFORE, AFTER, 2.0).points(np.array([[5.0, 0.0]])) == pytest.approx(np.array([[4.0, 3.0]]))


def test_views_map_exactly_to_their_new_poses():
    assert MapUpdate(BEFORE, AFTER, 2.0).poses(BEFORE) == pytest.approx(AFTER)


def test_views_between_them_move_as_points_do():
    (between,) = MapUpdate(BEFORE, AFTER, 2.0).poses(pose(5.0, 0.0)[None])
    assert between == pytest.approx(pose(4.0, 3.0, 1.2, np.pi / 2))


def test_of_views_at_one_place_the_newest_counts():
    both = MapUpdate(np.array([pose(0, 0), pose(0, 0)]), np.array([pose(0, 0), pose(0, 0.5)]))
    assert both.points(np.array([[1.0, 0.0]])) == pytest.approx(np.array([[1.0, 0.5]]))


def test_points_follow_the_view_nearest_in_time():
    """A piece of map lay across the first one by mistake, and moves away from it."""
    across = MapUpdate(
        np.array([pose(4.0, 0.0), pose(8.0, 0.0), pose(4.0, 0.0)]),
        np.array([pose(4.0, 0.0), pose(8.0, 0.0), pose(5.5, 0.0)]),
        pictures=np.array([10, 20, 50]),
    )
    door = np.array([[5.0, 1.0], [5.0, 1.0], [5.0, 1.0], [5.0, 1.0]])
    moved = across.points(door, [10, 13, 48, -1])
    assert moved == pytest.approx(np.array([[5.0, 1.0], [5.0, 1.0], [6.5, 1.0], [6.5, 1.0]]))
    assert across.points(door[:1]) == pytest.approx(np.array([[6.5, 1.0]])), "which picture is not known"
    unnumbered = MapUpdate(across.before_w, across.after_w)
    assert unnumbered.points(door[:1], [10]) == pytest.approx(np.array([[6.5, 1.0]]))


def test_no_points_map_to_no_points():
    assert MapUpdate(BEFORE, AFTER).points(np.zeros((0, 3))).shape == (0, 3)


def test_moves_below_a_cell_are_ignored():
    shifted = BEFORE.copy()
    shifted[0, 0, 3] += 0.11
    assert moves(BEFORE, shifted, 0.1)
    shifted[0, 0, 3] -= 0.05
    assert not moves(BEFORE, shifted, 0.1)
