"""Rays of depth at a wall with a known opening."""

import math

import numpy as np
import pytest
from views import moved

from edgeslam_torch.navigation.drone_state import DroneState, View
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapViews
from edgeslam_torch.navigation.openings.depth_rays import DepthRays
from edgeslam_torch.navigation.openings.exit_tracker import ExitTracker
from edgeslam_torch.navigation.openings.exits import openings
from edgeslam_torch.navigation.openings.wall_frame import Walls, along_walls

K = np.array([[60.0, 0.0, 60.0], [0.0, 60.0, 45.0], [0.0, 0.0, 1.0]])
HEIGHT_M = 1.15
TILT_RAD = math.radians(12.0)


def looking(x, y, yaw_rad, tilt_rad=TILT_RAD):
    """Camera to world of a camera that is tilted down."""
    forward = np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
    right = np.array([math.sin(yaw_rad), -math.cos(yaw_rad), 0.0])
    z = math.cos(tilt_rad) * forward - math.sin(tilt_rad) * np.array([0.0, 0.0, 1.0])
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(z, right), z], axis=1)
    T[:3, 3] = x, y, HEIGHT_M
    return T


def picture(T_w_c, opening, behind_m, wall_x=2.0):
    """What a camera sees of an upright wall at ``wall_x``, of its opening ``(from, to)`` of y and of a second wall this
    far behind it."""
    u, v = np.meshgrid(np.arange(120), np.arange(90))
    ray = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], axis=-1) @ T_w_c[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (wall_x - T_w_c[0, 3]) / ray[..., 0]
        y = T_w_c[1, 3] + near * ray[..., 1]
        far = (wall_x + behind_m - T_w_c[0, 3]) / ray[..., 0]
    depth = np.where((y > opening[0]) & (y < opening[1]), far, near)
    depth[~(depth > 0)] = np.nan
    return View(0.0, depth, np.full(depth.shape, 0.1), K, T_w_c)


def walls(opening=(-0.45, 0.45), free_beyond=False, shut=0.0):
    """A grid with a wall across x whose opening is unknown, and free space in front."""
    x, y = np.meshgrid((np.arange(120) + 0.5) * 0.1 - 6.0, (np.arange(120) + 0.5) * 0.1 - 6.0, indexing="ij")
    upright = (np.abs(x - 2.0) < 0.1) & (np.abs(y) < 3.0) & ~((y > opening[0]) & (y < opening[1]))
    inside = (np.abs(x - 2.0) < 0.1) & (y > opening[0]) & (y < opening[1])
    solid = upright | (inside & (y > opening[1] - shut * (opening[1] - opening[0])))
    free = ~solid & ((x < 2.1) | free_beyond)
    return Walls(Layer(free, solid, np.array([-6.0, -6.0]), 0.1), upright)


def seen(known, view, here=(0.0, 0.0)):
    rays = DepthRays.of(view)
    found = openings(along_walls(known, np.array(here)))
    return [gap for gap in found if rays.pass_(gap.centre_w, gap.normal_w, gap.width_m)]


@pytest.mark.parametrize(("x", "y", "yaw_deg"), [(0.5, 0.0, 0.0), (0.8, -0.6, 30.0), (0.3, 1.2, -40.0)])
def test_door_is_a_hypothesis_before_free_space_confirms_it(x, y, yaw_deg):
    T = looking(x, y, math.radians(yaw_deg))
    (gap,) = seen(walls(), picture(T, (-0.45, 0.45), 2.0), (x, y))
    assert gap.centre_w == pytest.approx([2.0, 0.0], abs=0.12)
    assert gap.normal_w == pytest.approx([1.0, 0.0], abs=0.06), "away from the drone"
    assert gap.width_m == pytest.approx(0.9, abs=0.16)


@pytest.mark.parametrize(
    ("case", "known", "opening", "behind_m"),
    [
        ("a closed door in the same gap", walls(), (0.0, 0.0), 2.0),
        ("a niche", walls(), (-0.45, 0.45), 0.3),
        ("a gap that is known to be closed", walls(shut=0.5), (-0.45, 0.45), 2.0),
        ("too wide", walls((-1.0, 1.0)), (-1.0, 1.0), 2.0),
        ("too narrow", walls((-0.2, 0.2)), (-0.2, 0.2), 2.0),
        ("through a third of it", walls(), (0.15, 0.45), 2.0),
    ],
)
def test_closed_openings_yield_no_hypothesis(case, known, opening, behind_m):
    T = looking(0.5, 0.0, 0.0)
    assert seen(known, picture(T, opening, behind_m)) == [], case


def test_no_hypothesis_behind_the_camera_or_far_away():
    assert seen(walls(), picture(looking(0.5, 0.0, math.pi), (-0.45, 0.45), 2.0)) == []
    watch, view = ExitTracker(), picture(looking(-2.5, 0.0, 0.0), (-0.45, 0.45), 2.0)
    for k in range(4):
        watch.look(walls(), DroneState(0.5 * k, np.array([-2.5, 0.0, HEIGHT_M]), 0.0, np.zeros(3), view=view))
    assert watch.candidates == ()


@pytest.mark.parametrize("tilt_deg", [60.0, 90.0])
def test_a_camera_that_looks_at_the_floor_has_no_level_ray(tilt_deg):
    T = looking(0.5, 0.0, 0.0, tilt_rad=math.radians(tilt_deg))
    if tilt_deg == 90.0:
        T[2, :3] = 0.0, 0.0, -1.0  # to the last bit
    assert seen(walls(), picture(T, (-0.45, 0.45), 2.0)) == []


def test_two_hypotheses_make_a_candidate_but_no_exit():
    watch, T = ExitTracker(), looking(0.5, 0.0, 0.0)
    view = picture(T, (-0.45, 0.45), 2.0)
    for k in range(4):
        assert bool(watch.candidates) == (k >= 2)
        watch.look(walls(), DroneState(0.5 * k, np.array([0.5, 0.0, HEIGHT_M]), 0.0, np.zeros(3), view=view))
    (candidate,) = watch.candidates
    assert candidate.centre_w == pytest.approx([2.0, 0.0], abs=0.12)
    assert len(candidate.saturated_w) == 0, "rays alone do not saturate a viewpoint"
    assert watch.exits == ()
    for k in range(4, 12):
        here = np.array([0.5 if k < 8 else 1.1, 0.0, HEIGHT_M])
        watch.look(walls(free_beyond=True), DroneState(0.5 * k, here, 0.0, np.zeros(3), view=view))
    assert len(watch.exits) == 1
    assert watch.candidates == (), "it is one now"


def test_hypotheses_follow_map_corrections():
    watch, T, views = ExitTracker(), looking(0.5, 0.0, 0.0), MapViews()
    views.add(0, np.eye(4))
    for k in range(3):
        here, view = np.array([0.5, 0.0, HEIGHT_M]), picture(T, (-0.45, 0.45), 2.0)
        watch.look(walls(), DroneState(0.5 * k, here, 0.0, np.zeros(3), view=view, views=views))
    away = np.eye(4)
    away[1, 3] = 1.0
    views.correct(moved(0, away))
    watch.look(walls((0.55, 1.45)), DroneState(2.0, np.array([0.5, 1.0, HEIGHT_M]), 0.0, np.zeros(3)))
    (candidate,) = watch.candidates
    assert candidate.centre_w == pytest.approx([2.0, 1.0], abs=0.12)
