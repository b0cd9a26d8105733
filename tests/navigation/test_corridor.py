"""Following a corridor, against corridors whose walls are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from views import moved

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapViews
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.navigation.skills.follow_corridor import FollowCorridor
from edgeslam_torch.navigation.views import ViewPlanner


def seen(is_solid, is_unseen=lambda x, y: np.zeros(x.shape, bool)):
    """A square of 12 m around the origin."""
    x, y = np.meshgrid((np.arange(120) + 0.5) * 0.1 - 6.0, (np.arange(120) + 0.5) * 0.1 - 6.0, indexing="ij")
    solid, unseen = is_solid(x, y), is_unseen(x, y)
    return Layer(~solid & ~unseen, solid & ~unseen, np.array([-6.0, -6.0]), 0.1)


def state(x, y=0.0, stamp_s=0.0, yaw=0.0):
    return DroneState(stamp_s, np.array([x, y, 1.15]), yaw, np.zeros(3))


def goals(task, layer, at, views=None):
    """Goal cells ``(G, 2)``."""
    return task.goals(layer, at, views or ViewPlanner(0.15))


def place(task, layer, at):
    """Goal ``(2,)``."""
    (cell,) = goals(task, layer, at)
    return layer.centres(cell)


def follow(task, layer, *way):
    """Goal at the end of a path."""
    for k, (x, y) in enumerate(way[:-1]):
        goals(task, layer, state(x, y, 0.5 * k))
    return place(task, layer, state(*way[-1], 0.5 * len(way)))


def sides(width=2.0, end=5.0):
    """A straight corridor along x, closed at its end."""
    return lambda x, y: (np.abs(y) > 0.5 * width) | (x > end)


def with_door(gap, at=2.0):
    """A wall across a corridor of 2 m, with an opening of this width in its middle."""
    across = lambda x, y: (np.abs(x - at) < 0.1) & (np.abs(y) > 0.5 * gap - 0.05)  # noqa: E731
    return lambda x, y: sides()(x, y) | across(x, y)


def corner(x, y):
    """A corridor of 2 m from behind the origin to a wall at 4 m, where another leads to the left."""
    along, turn = (np.abs(y) < 1.0) & (x < 4.0), (y > -1.0) & (x > 2.0) & (x < 4.0)
    return ~(along | turn)


def test_a_corridor_is_followed_ahead_then_round_its_corner():
    task = FollowCorridor()
    ahead = seen(corner, lambda x, y: (x > 1.5) | (x < -1.0))
    assert place(task, ahead, state(0.0))[0] > 1.0
    whole = seen(corner, lambda x, y: (y > 2.0) | (x < -1.0))
    for k in range(4):
        goals(task, whole, state(0.9 * k, stamp_s=k))
    assert place(task, whole, state(3.0, stamp_s=5.0, yaw=1.5))[1] > 1.0, "not back to what is unseen behind the start"


def test_a_drone_that_flies_aslant_goes_on_along_the_walls():
    """After a metre at 20 degrees to them: something stood at one side."""
    layer = seen(lambda x, y: sides()(x, y) | (np.abs(x - 3.0) < 0.2) & (y > 0.9))
    last = follow(FollowCorridor(), layer, (-1.0, -0.4), (-0.5, -0.2), (0.0, 0.0), (0.3, 0.1))
    assert last == pytest.approx([4.4, 0.0], abs=0.2)


def test_unknown_space_behind_the_start_is_ignored():
    """Two metres behind it, which is not beside its way: at the end of the corridor it does not turn back to it."""
    layer = seen(lambda x, y: (np.abs(y) > 1.0) | (x > 4.0), lambda x, y: x < -2.0)
    task = FollowCorridor()
    goals(task, layer, state(0.0))
    goals(task, layer, state(3.3, stamp_s=5.0))
    assert len(task._end)


@pytest.mark.parametrize("width", [2.0, 2.4])
def test_corridor_flown_along_one_side_is_no_continuation(width):
    layer = seen(sides(width), lambda x, y: np.abs(y - 0.5 * width + 0.1) < 0.1)
    way = [(x, 0.6 - 0.5 * width) for x in np.arange(-4.0, 4.7, 0.4)]
    task = FollowCorridor()
    for k, (x, y) in enumerate(way):
        goals(task, layer, state(x, y, 0.5 * k))
    assert len(task._end), "it is at the end"


def test_a_door_is_no_corridor():
    """Free space behind a doorway is not part of what is followed: the goal stays before it."""
    assert place(FollowCorridor(), seen(with_door(0.9)), state(0.0))[0] < 1.9


def test_narrow_space_ahead_is_entered_unless_it_is_a_door():
    """Depth that is too near makes a corridor as narrow as a door for half a metre."""
    narrow = seen(lambda x, y: sides()(x, y) | (np.abs(x - 2.0) < 0.3) & (np.abs(y) > 0.4))
    way = [(x, 0.0) for x in (-1.0, -0.5, 0.0, 0.5, 1.0, 1.3)]
    assert follow(FollowCorridor(), narrow, *way)[0] > 4.0
    ahead, to_the_left = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    for middle, normal, far in ((1.8, ahead, False), (1.8, to_the_left, True), (-3.0, ahead, True)):
        task = FollowCorridor()
        task.consider([Exit(np.array([middle, 0.2, 1.15]), np.array([*normal, 0.0]), 0.9, 0.1, 0.1, 2)])
        last = follow(task, narrow, *[(x, 0.0) for x in (-1.0, -0.5, 0.0, 0.5)], (1.0, 0.0))
        assert bool(last[0] > 4.0) is far


def test_noise_beside_the_start_does_not_end_the_corridor():
    """The wide free space begins farther than a metre away."""
    speck = lambda x, y: (np.abs(x - 0.4) < 0.1) & (np.abs(y - 0.5) < 0.1)  # noqa: E731
    layer = seen(lambda x, y: sides()(x, y) | speck(x, y) | (x < 0.7) & (y < -0.5))
    assert place(FollowCorridor(), layer, state(0.0))[0] > 3.0


def test_unknown_space_ahead_is_the_goal():
    nothing = seen(lambda x, y: np.abs(y) > 1.0, lambda x, y: np.abs(x) > 0.3)
    assert place(FollowCorridor(), nothing, state(0.0)) == pytest.approx([1.5, 0.0], abs=0.1)
    assert len(goals(FollowCorridor(), seen(lambda x, y: x > 1.2, lambda x, y: np.abs(x) > 0.3), state(0.0)))
    task = FollowCorridor()
    goals(task, seen(sides(end=0.9)), state(0.4))
    assert len(task._end)


def test_backing_up_keeps_the_direction():
    """Its pose was lost, and the supervisor flew it back along its way."""
    layer = seen(sides(), lambda x, y: x > 4.0)
    way = [(x, 0.0) for x in np.arange(-4.0, 2.1, 0.5)]
    assert follow(FollowCorridor(), layer, *way, (1.0, 0.1), (0.0, 0.0), (-1.0, 0.0))[0] > 3.0


def stub(x, y):
    """A corridor of 2 m that ends at 3 m; from -1 to 1 m another leads to the left."""
    return ~((np.abs(y) < 1.0) & (x < 3.0) | (np.abs(x) < 1.0) & (y > 0.0))


def test_dead_end_leads_back_to_the_side_corridor():
    task, layer = FollowCorridor(), seen(stub)
    to_its_end = [(x, 0.0) for x in np.arange(-4.0, 2.3, 0.4)]
    assert follow(task, layer, *to_its_end)[1] > 1.6
    for x in (1.6, 1.0, 0.5, 0.1):
        assert place(task, layer, state(x, 0.1, 20.0 - x))[1] > 1.6, "not into the dead end again"
    for y in (0.6, 1.2, 1.8):
        last = place(task, layer, state(0.0, y, 30.0 + y))
    assert last == pytest.approx([0.0, 5.4], abs=0.4), "ahead is where it flies now"


def test_side_corridor_is_entered_once_its_mouth_is_seen():
    """From the dead end only a strip half a metre wide is visible of the side corridor."""
    mouth = lambda x, y: (np.abs(x) < 0.9) & (y < 1.2) | (np.abs(x - 0.3 + 0.5 * (y - 1.0)) < 0.2) & (y < 1.8)  # noqa: E731
    layer = seen(stub, lambda x, y: (y > 0.9) & ~mouth(x, y))
    last = follow(FollowCorridor(), layer, *[(x, -0.2) for x in np.arange(-4.0, 2.3, 0.4)])
    assert last == pytest.approx([0.0, 1.6], abs=0.3)


def at_the_end(task, layer, end_m=2.4):
    """Goals of a task that has come to an apparent end."""
    for k, x in enumerate(np.arange(-4.0, end_m + 0.1, 0.4)):
        found = goals(task, layer, state(x, 0.0, 0.5 * k))
    return layer.centres(found).reshape(-1, 2)


def test_at_an_apparent_end_unknown_sides_are_viewed_and_then_it_ends():
    """A drone that is at its goal at once."""
    task, layer, views = FollowCorridor(), seen(stub, lambda x, y: (y > 0.9) & (x < 2.6)), ViewPlanner(0.15)
    at_the_end(task, layer)
    assert task.result(state(2.4, stamp_s=9.0)) is None, "there may be a side corridor"
    here, to_left = state(2.4, stamp_s=10.0), []
    while here.stamp_s < 200.0 and not task.result(here):
        here = replace(here, stamp_s=here.stamp_s + 0.1)
        if (wanted := views.taking(here)) is not None:
            turn = np.clip(here.turn_to_rad(wanted.heading_rad), -0.1, 0.1)
            here = replace(here, yaw_rad=here.yaw_rad + float(turn))
            to_left.append(math.sin(here.yaw_rad))
        elif not task.looks(here, views) and len(cells := goals(task, layer, here, views)):
            found = layer.centres(cells)
            assert np.linalg.norm(found - [2.4, 0.0], axis=1).max() < 3.0, "near the end only"
            here = replace(here, p_w=np.array([*found[np.abs(found[:, 0] - here.p_w[0]).argmin()], 1.15]))
    assert task.result(here).reached and task.result(here).reason == "the corridor ends"
    assert abs(here.p_w[0] - 2.4) < 0.4
    assert max(to_left) > 0.95 and min(to_left) < -0.95, "depth may have closed a mouth on either side"


def test_a_mouth_that_depth_closed_is_seen_from_before_it():
    """Passing it at a grazing angle put a wall across it; a view of it from before it takes the wall away."""
    wall = lambda x, y: (np.abs(y - 1.1) < 0.15) & (np.abs(x) < 1.2)  # noqa: E731
    closed, open_ = seen(lambda x, y: stub(x, y) | wall(x, y)), seen(stub)
    task, views, layer, here = FollowCorridor(), ViewPlanner(0.15), closed, state(2.4, stamp_s=10.0)
    at_the_end(task, layer)
    while here.stamp_s < 200.0 and not task.result(here):
        here = replace(here, stamp_s=here.stamp_s + 0.1)
        if (wanted := views.taking(here)) is not None:
            here = replace(here, yaw_rad=wanted.heading_rad)
            if abs(here.p_w[0]) < 0.35 and math.sin(here.yaw_rad) > 0.9:
                layer = open_
        elif not task.looks(here, views):
            to = layer.centres(goals(task, layer, here, views)[0])
            if to[1] > 1.6:
                return
            here = replace(here, p_w=np.array([*to, 1.15]))
    pytest.fail("the side corridor was not entered")


def test_a_side_corridor_that_a_view_shows_is_followed():
    task = FollowCorridor()
    at_the_end(task, seen(stub, lambda x, y: (y > 0.9) & (x < 2.6)))
    assert place(task, seen(stub), state(2.3, 0.0, 20.0))[1] > 1.6


def test_a_bare_wall_at_the_end_is_not_viewed_for_ever():
    task, layer = FollowCorridor(), seen(stub, lambda x, y: (y > 0.9) & (x < 2.6))
    at_the_end(task, layer)
    assert task.result(state(2.4, stamp_s=9.0), losses=2) is None
    result = task.result(state(2.4, stamp_s=9.0), losses=3)
    assert result.reached


def test_a_corridor_ends_in_a_room():
    task, room = FollowCorridor(), seen(lambda x, y: np.maximum(np.abs(x), np.abs(y)) > 2.5)
    for k in range(5):
        goals(task, room, state(0.3 * k - 0.6, stamp_s=k))
        done = task.result(state(0.3 * k - 0.6, stamp_s=k))
    assert done is None, "a metre must have been flown: a take-off in a room is no corridor's end"
    goals(task, room, state(0.6, stamp_s=5.0))
    goals(task, room, state(0.6, stamp_s=8.0))
    assert task.result(state(0.6, stamp_s=8.0)).reason == "the corridor opens into a room"


def test_the_goal_is_in_the_middle_of_the_far_end():
    """Whatever is unseen beside the way, and however aslant it flies."""
    layer = seen(sides(), lambda x, y: np.abs(y - 0.9) < 0.2)
    assert place(FollowCorridor(), layer, state(0.0, yaw=0.35)) == pytest.approx([4.4, 0.0], abs=0.3)


def test_a_narrowed_end_is_viewed_before_it_ends():
    """By errors of depth the last metre and a half is too narrow for a viewpoint; the drone looks from where it is."""
    task = FollowCorridor()
    at_the_end(task, seen(lambda x, y: sides(end=3.0)(x, y) | (x > 1.2) & (np.abs(y) > 0.5)))
    assert len(task._end) and task.result(state(2.4, stamp_s=9.0)) is None


def test_it_moves_with_the_map():
    """Two metres to the left: the way flown stays the way flown, and what turns off what it flies to."""
    to = np.eye(4)
    to[1, 3] = 2.0
    for shape, left_m in ((stub, 3.6), (sides(end=3.0), math.nan)):
        task, views = FollowCorridor(), MapViews()
        views.add(0, np.eye(4))
        for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
            goals(task, seen(shape), replace(state(x, 0.0, 0.5 * k), views=views))
        views.correct(moved(0, to))
        there = seen(lambda x, y: shape(x, y - 2.0))  # noqa: B023
        found = there.centres(goals(task, there, state(2.4, 2.0, 30.0)))
        assert (found[:, 1] > left_m).all() if math.isfinite(left_m) else len(task._end)


def test_unknown_space_beside_the_path_is_no_continuation():
    """Unseen ground half a metre behind the start, and nothing else to see: the far end is the goal."""
    layer = seen(lambda x, y: (np.abs(y) > 1.0) | (x > 4.0), lambda x, y: x < -0.5)
    task = FollowCorridor()
    assert place(task, layer, state(0.0))[0] > 3.0
    goals(task, layer, state(3.2, stamp_s=5.0))
    goals(task, layer, state(3.3, stamp_s=5.5))
    assert len(task._end)
