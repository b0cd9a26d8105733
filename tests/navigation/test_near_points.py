"""Map points in front of a depth map."""

import numpy as np
import pytest

from edgeslam_torch.navigation.near.points import MIN_AGREEING, SIGMA_LOG, agreeing, seen_points, with_nearer_points
from edgeslam_torch.types import DepthMap

K = np.array([[100.0, 0.0, 59.5], [0.0, 100.0, 44.5], [0.0, 0.0, 1.0]])
WALL = DepthMap(np.full((90, 120), 3.0, np.float32), np.full((90, 120), 0.3, np.float32))
AT = np.array([[60.2, 44.8]])


def cluster(z=0.8, u=60.0, v=45.0, count=MIN_AGREEING):
    """Points within half a pixel of each other."""
    return np.column_stack([u + 0.1 * np.arange(count), np.full(count, v)]), np.full(count, z)


def test_a_point_before_the_wall_is_taken_and_is_sure():
    told = with_nearer_points(WALL, AT, np.array([0.8]))
    assert told.depth_m[45, 60] == pytest.approx(0.8)
    assert told.sigma_log[45, 60] == pytest.approx(SIGMA_LOG)
    assert (np.delete(told.depth_m.ravel(), 45 * 120 + 60) == 3.0).all(), "and nothing else changes"
    assert (np.delete(told.sigma_log.ravel(), 45 * 120 + 60) == np.float32(0.3)).all()


def test_the_nearest_of_the_points_in_a_pixel_counts():
    assert with_nearer_points(WALL, np.repeat(AT, 3, 0), np.array([1.2, 0.7, 0.9])).depth_m[45, 60] == np.float32(0.7)


def test_nearer_network_depth_is_kept():
    told = with_nearer_points(WALL, AT, np.array([5.0]))
    assert (told.depth_m == 3.0).all() and (told.sigma_log == np.float32(0.3)).all()


def test_points_fill_unknown_network_depth():
    unknown = DepthMap(np.full((90, 120), np.nan, np.float32), np.full((90, 120), np.nan, np.float32))
    told = with_nearer_points(unknown, AT, np.array([2.0]))
    assert told.depth_m[45, 60] == pytest.approx(2.0) and np.isfinite(told.sigma_log[45, 60])
    assert np.isnan(told.depth_m).sum() == 90 * 120 - 1


def test_a_map_without_points_changes_nothing():
    none = np.zeros((0, 2)), np.zeros(0)
    assert len(agreeing(*none, 120)) == 0
    assert (with_nearer_points(WALL, *none).depth_m == 3.0).all()


def test_points_agree_when_there_are_enough_in_one_place():
    assert agreeing(*cluster(), 120).tolist() == list(range(MIN_AGREEING))
    assert len(agreeing(*cluster(count=MIN_AGREEING - 1), 120)) == 0
    assert len(agreeing(np.array([[20.0, 20.0], [60.0, 45.0], [100.0, 70.0]]), np.full(3, 0.8), 120)) == 0
    assert len(agreeing(cluster()[0], np.array([0.8, 1.2, 1.9]), 120)) == 0, "behind each other is not together"


@pytest.mark.parametrize("shift", np.linspace(0.0, 2.4, 9))
def test_cell_borders_do_not_split_groups(shift):
    assert len(agreeing(*cluster(0.8 * np.exp(0.05 * shift), u=59.0 + shift), 120)) == MIN_AGREEING


def test_points_project_only_in_front_of_the_camera():
    T_w_c = np.eye(4)
    T_w_c[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]  # looks along x
    T_w_c[:3, 3] = [1.0, 2.0, 0.5]
    p_w = np.array([[3.0, 2.0, 0.5], [3.0, 1.8, 0.5], [-1.0, 2.0, 0.5], [3.0, 9.0, 0.5]])
    uv, z = seen_points(p_w, K, T_w_c, (90, 120))
    assert uv == pytest.approx(np.array([[59.5, 44.5], [69.5, 44.5]])), "a point to the right is right in the picture"
    assert z == pytest.approx([2.0, 2.0])
