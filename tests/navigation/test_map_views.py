"""Positions tied to views are where the corrected map has them."""

import numpy as np
import pytest
from views import longer, moved

from edgeslam_torch.navigation.map_views import MapUpdate, MapViews, Places, moves


def pose(x, y, z=1.0, yaw=0.0):
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = [x, y, z]
    return T


BEFORE = np.array([pose(0.0, 0.0), pose(4.0, 0.0)])
TURNED = pose(4.0, 1.0, 1.2, np.pi / 2)


def seen(*poses, first=0):
    views = MapViews()
    for k, T in enumerate(poses):
        views.add(first + k, T)
    return views


@pytest.mark.parametrize(
    ("point", "where"),
    [([5.0, 0.0, 1.5], [4.0, 3.0, 2.2]), ([5.0, 0.0], [4.0, 3.0])],
    ids=["in space", "at the height of its view"],
)
def test_a_point_turns_and_grows_about_its_view(point, where):
    """The view moves by (0, 1, 0.2) and turns square to the left: what was 1 m before it is 2 m to its left."""
    views = seen(*BEFORE)
    places = Places(views, point, size=len(point))
    assert places.p_w == pytest.approx(np.array([point]))
    views.correct(moved(1, TURNED, 2.0))
    assert places.p_w == pytest.approx(np.array([where]))
    assert places.last_w == pytest.approx(where)


def test_points_are_exact_wherever_and_whenever_they_are_added(rng):
    """Added before and after corrections, among random poses: read back as given, and moved as their view was."""
    turns = [pose(*rng.uniform(-3, 3, 3), rng.uniform(-3, 3)) for _ in range(8)]
    views, points, places = seen(*turns[:4]), rng.uniform(-5, 5, (6, 3)), Places(size=3)
    places.add(views, points[:3])
    views.correct(MapUpdate(np.arange(4), np.array(turns[4:]), 1.7))
    places.add(views, points[3:])
    local = (points[:3] - turns[3][:3, 3]) @ turns[3][:3, :3]
    there = 1.7 * local @ turns[7][:3, :3].T + turns[7][:3, 3]
    assert places.p_w == pytest.approx(np.concatenate([there, points[3:]]))


def test_views_that_a_correction_leaves_out_go_with_the_nearest_in_time():
    views = seen(pose(0.0, 0.0), pose(1.0, 0.0), pose(9.0, 0.0), first=10)
    views.correct(MapUpdate(np.array([10, 12]), np.array([pose(0.0, 2.0, yaw=np.pi / 2), pose(9.0, 0.0)])))
    assert views.pose_of(11) == pytest.approx(pose(0.0, 3.0, yaw=np.pi / 2))
    assert views.pose_of(12) == pytest.approx(pose(9.0, 0.0))
    assert views.pose_of(13) is None


def test_a_path_flown_long_ago_goes_with_the_views_along_it():
    views, places = seen(*BEFORE), Places()
    places.add(views, [[0.1, 0.0], [3.9, 0.0]], nearest=True)
    views.correct(MapUpdate(np.array([0, 1]), np.array([pose(0.0, 5.0), pose(4.0, 0.0)])))
    assert places.p_w == pytest.approx(np.array([[0.1, 5.0], [3.9, 0.0]]))


def test_before_the_first_view_points_belong_to_the_take_off():
    views = MapViews()
    places = Places(views, [1.0, 2.0])
    views.add(0, pose(1.0, 2.0))
    views.correct(moved(0, pose(7.0, 7.0)))
    assert places.p_w == pytest.approx(np.array([[1.0, 2.0]]))
    views.correct(longer(2.0))
    assert places.p_w == pytest.approx(np.array([[2.0, 4.0]]))


def test_moves_below_a_cell_are_ignored():
    shifted = BEFORE.copy()
    shifted[0, 0, 3] += 0.11
    assert moves(BEFORE, shifted, 0.1)
    shifted[0, 0, 3] -= 0.05
    assert not moves(BEFORE, shifted, 0.1)


def test_points_estimated_anew_stay_tied_to_their_views():
    views = MapViews()
    views.add(3, np.eye(4))
    places = Places(views, [[2.0, 0.0]])
    views.add(4, np.eye(4))
    places.move(np.array([[2.2, 0.0]]))
    to = np.eye(4)
    to[1, 3] = 1.0
    views.correct(moved(3, to))
    assert places.p_w.tolist() == [[2.2, 1.0]]
    assert places.away_m(np.array([[2.2, 0.0], [5.2, 5.0]])).tolist() == [1.0, 5.0]
    assert Places().away_m(np.zeros(2)) == np.inf
