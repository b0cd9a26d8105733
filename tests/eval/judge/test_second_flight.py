"""When a known place comes into view, and how long a unit is, by depth maps; worked out by hand."""

import math

import numpy as np
import pytest

from edgeslam_torch.eval.judge.second_flight import View, known_after_s, metre_by_depth
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def before_a_wall(aside=0.0, back=0.0, turn_rad=0.0, depth_m=2.0, unit=1.0):
    """A view of a wall 2 m ahead of the origin, from beside or behind it; the run's unit is ``unit`` metres."""
    T_w_c = se3.exp(np.array([0.0, 0.0, 0.0, 0.0, turn_rad, 0.0]))
    T_w_c[:3, 3] = aside, 0.0, -back
    T_run = T_w_c.copy()
    T_run[:3, 3] /= unit
    return View(CAMERA, T_w_c, np.full((48, 64), depth_m + back, np.float32), np.eye(4), T_run)


HALF_M = 32 / 60 * 2.0
"""Half of what is seen of the wall."""


@pytest.mark.parametrize(
    ("view", "known"),
    [
        (before_a_wall(), True),
        (before_a_wall(aside=0.4 * HALF_M), True),
        (before_a_wall(aside=1.2 * HALF_M), False),  # less than half is shared
        (before_a_wall(back=0.8), True),
        (before_a_wall(back=1.4), False),  # 1.7 times as far
        (before_a_wall(turn_rad=math.pi), False),
    ],
)
def test_a_view_is_known_when_half_of_it_was_seen_much_like_that(view, known):
    after = known_after_s([before_a_wall()], [(10.5, view)], begin_s=10.0)
    assert after == (pytest.approx(0.5) if known else math.inf)


def test_the_first_known_view_counts():
    away = before_a_wall(turn_rad=math.pi)
    second = [(0.0, away), (0.5, away), (1.0, before_a_wall()), (1.5, before_a_wall())]
    assert known_after_s([away, before_a_wall()], [(t, v) for t, v in second[:1]], 0.0) == 0.0
    assert known_after_s([before_a_wall()], second, 0.0) == 1.0


def test_what_stood_before_the_wall_hides_it():
    hidden = before_a_wall(depth_m=1.0)
    assert known_after_s([hidden], [(0.0, before_a_wall())], 0.0) == math.inf


@pytest.mark.parametrize("unit", [1.0, 1.08, 0.93])
def test_metres_of_a_unit_by_depth_maps(unit):
    """A map that is right but for its unit, with a tenth of its points elsewhere."""
    views = [before_a_wall(aside=x, unit=unit) for x in (-0.2, 0.0, 0.3)]
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.full(200, 2.0)])
    wall[:20, 2] = rng.uniform(0.2, 1.5, 20)
    assert metre_by_depth(views, wall / unit) == pytest.approx(unit, rel=1e-6)


def test_without_points_in_view_the_unit_is_not_known():
    assert metre_by_depth([before_a_wall()], np.array([[0.0, 0.0, -1.0], [9.0, 9.0, 2.0]])) is None
    assert metre_by_depth([], np.zeros((0, 3))) is None
