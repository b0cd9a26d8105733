"""Following a corridor, against corridors whose walls are known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from views import moved

from edgeslam_torch.navigation.corridor.corridor_geometry import mouths
from edgeslam_torch.navigation.corridor.follow import FollowCorridor
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapViews
from edgeslam_torch.navigation.openings.exit_tracker import Candidate, Exit


def seen(is_solid, is_unseen=lambda x, y: np.zeros(x.shape, bool)):
    """A square of 12 m around the origin."""
    x, y = np.meshgrid((np.arange(120) + 0.5) * 0.1 - 6.0, (np.arange(120) + 0.5) * 0.1 - 6.0, indexing="ij")
    solid, unseen = is_solid(x, y), is_unseen(x, y)
    return Layer(~solid & ~unseen, solid & ~unseen, np.array([-6.0, -6.0]), 0.1)


def state(x, y=0.0, stamp_s=0.0, yaw=0.0):
    return DroneState(stamp_s, np.array([x, y, 1.15]), yaw, np.zeros(3))


def place(task, layer, at):
    """Goal ``(2,)``."""
    (cell,) = task.goals(layer, at)
    return layer.centres(cell)


def follow(task, layer, *way):
    """Goal at the end of a path."""
    for k, (x, y) in enumerate(way[:-1]):
        task.goals(layer, state(x, y, 0.5 * k))
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
        task.goals(whole, state(0.9 * k, stamp_s=k))
    assert place(task, whole, state(3.0, stamp_s=5.0, yaw=1.5))[1] > 1.0, "not back to what is unseen behind the start"


def test_the_goal_is_in_the_middle_of_the_far_end():
    """Whatever is unseen beside the way, and however aslant it flies."""
    layer = seen(sides(), lambda x, y: np.abs(y - 0.9) < 0.2)
    assert place(FollowCorridor(), layer, state(0.0, yaw=0.35)) == pytest.approx([4.4, 0.0], abs=0.2)


def test_a_drone_that_flies_aslant_goes_on_along_the_walls():
    """After a metre at 20 degrees to them: something stood at one side."""
    layer = seen(lambda x, y: sides()(x, y) | (np.abs(x - 3.0) < 0.2) & (y > 0.9))
    last = follow(FollowCorridor(), layer, (-1.0, -0.4), (-0.5, -0.2), (0.0, 0.0), (0.3, 0.1))
    assert last == pytest.approx([4.4, 0.0], abs=0.2)


def test_unknown_space_behind_the_start_is_ignored():
    """Two metres behind it, which is not beside its way: at the end of the corridor it does not turn back to it."""
    layer = seen(lambda x, y: (np.abs(y) > 1.0) | (x > 4.0), lambda x, y: x < -2.0)
    task = FollowCorridor()
    task.goals(layer, state(0.0))
    assert len(task.goals(layer, state(3.3, stamp_s=5.0))) == 0


@pytest.mark.parametrize("width", [2.0, 2.4])
def test_corridor_flown_along_one_side_is_no_continuation(width):
    layer = seen(sides(width), lambda x, y: np.abs(y - 0.5 * width + 0.1) < 0.1)
    way = [(x, 0.6 - 0.5 * width) for x in np.arange(-4.0, 4.7, 0.4)]
    task = FollowCorridor()
    for k, (x, y) in enumerate(way):
        found = task.goals(layer, state(x, y, 0.5 * k))
    assert len(found) == 0, "a turn on the spot at the end"


def test_end_needs_an_obstacle_ahead():
    """At 1 m before the end with a door in its middle; in the middle of it; where the sides alone are near."""
    task = FollowCorridor()
    ending = seen(with_door(0.9))
    task.goals(ending, state(-1.0))
    assert not task.wall
    task.goals(ending, state(1.0, stamp_s=4.0))
    assert task.wall


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
        task.consider([Candidate(np.array([middle, 0.2]), normal, np.zeros((0, 2)))])
        last = follow(task, narrow, *[(x, 0.0) for x in (-1.0, -0.5, 0.0, 0.5)], (1.0, 0.0))
        assert bool(last[0] > 4.0) is far
    task, wide = FollowCorridor(), np.array([1.8, 0.2, 1.15])
    task.consider([], [Exit(wide, np.array([1.0, 0.0, 0.0]), 0.9, 0.1, 0.1, 2)])
    assert follow(task, narrow, *[(x, 0.0) for x in (-1.0, -0.5, 0.0, 0.5)], (1.0, 0.0))[0] < 1.8


def test_noise_beside_the_start_does_not_end_the_corridor():
    """The wide free space begins farther than a metre away."""
    speck = lambda x, y: (np.abs(x - 0.4) < 0.1) & (np.abs(y - 0.5) < 0.1)  # noqa: E731
    layer = seen(lambda x, y: sides()(x, y) | speck(x, y) | (x < 0.7) & (y < -0.5))
    assert place(FollowCorridor(), layer, state(0.0))[0] > 3.0


def test_unknown_space_ahead_is_the_goal():
    nothing = seen(lambda x, y: np.abs(y) > 1.0, lambda x, y: np.abs(x) > 0.3)
    assert place(FollowCorridor(), nothing, state(0.0)) == pytest.approx([1.5, 0.0], abs=0.1)
    assert len(FollowCorridor().goals(seen(lambda x, y: x > 1.2, lambda x, y: np.abs(x) > 0.3), state(0.0)))
    assert len(FollowCorridor().goals(seen(sides(end=0.9)), state(0.4))) == 0


def test_backing_up_keeps_the_direction():
    """Its pose was lost, and the supervisor flew it back along its way."""
    layer = seen(sides(), lambda x, y: x > 4.0)
    way = [(x, 0.0) for x in np.arange(-4.0, 2.1, 0.5)]
    assert follow(FollowCorridor(), layer, *way, (1.0, 0.1), (0.0, 0.0), (-1.0, 0.0))[0] > 3.0


ALONG_X = np.array([[x, 0.0] for x in range(3)])
"""A way, a metre from place to place."""


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


def test_side_openings_are_inspected_before_a_wall():
    """In passing, only the missing wall of the side corridor was observed."""
    layer = seen(stub, lambda x, y: (y > 0.9) & (np.abs(x) < 1.0))
    to_its_end = [(x, 0.0) for x in np.arange(-4.0, 2.5, 0.4)]
    assert follow(FollowCorridor(), layer, *to_its_end) == pytest.approx([0.0, 1.2], abs=0.2)
    specks = seen(lambda x, y: stub(x, y) | (np.abs(x) < 0.1) & (np.abs(y - 0.6) < 0.1), lambda x, y: y > 2.0)
    assert len(mouths(specks, np.array([2.4, 0.0]), np.array([1.0, 0.0]), ALONG_X)) == 1, "noise is no wall"
    door = seen(lambda x, y: (np.abs(y) > 1.0) & ((np.abs(x) > 0.5) | (y < 0.0)) | (x > 3.0), lambda x, y: y > 1.1)
    assert len(mouths(door, np.array([2.4, 0.0]), np.array([1.0, 0.0]), ALONG_X)) == 0, "a door is none"


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_entry_corridor_is_no_side_opening(side):
    """Otherwise the drone would return to the dead end from the other corridor."""
    layer = seen(stub, lambda x, y: (np.abs(x) < 1.0) & (y < -2.0))
    end, axis = np.array([0.0, 4.0]), np.array([0.0, 1.0])
    for past in (0.0, 0.8 * side):
        way = np.stack([np.full(5, past), np.arange(5.0)], 1)
        assert len(mouths(layer, end, axis, way)) == 2, "flown past, not through"
    to_the_dead_end = ALONG_X * [side, 1.0] + [0.0, 0.4]
    assert layer.centres(mouths(layer, end, axis, to_the_dead_end))[:, 0] * side == pytest.approx([-1.2], abs=0.1)


def before_a_wall(task, layer):
    """Goals at the dead end during the full turn and at the viewpoint of the side looks."""
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        found = task.goals(layer, state(x, 0.0, 0.5 * k))
    assert len(found) == 0, "a turn on the spot first"
    wanted = place(task, layer, state(2.4, 0.0, 20.6))
    for x in (2.0, 1.6, 1.2, 0.8, 0.3):
        assert task.heading_rad(state(x, 0.0, 24.0 - x)) is None, "not there yet"
        task.goals(layer, state(x, 0.0, 24.0 - x))
    return wanted


def test_unknown_sides_are_scanned_before_the_end():
    """Nothing of the side corridor was observed in passing."""
    layer, task = seen(stub, lambda x, y: (y > 0.9) & (x < 2.6)), FollowCorridor()
    assert before_a_wall(task, layer) == pytest.approx([0.2, 0.0], abs=0.1)
    assert task.heading_rad(state(0.3, 0.0, 25.0)) == pytest.approx(math.pi / 2)
    assert task.heading_rad(state(0.3, 0.0, 25.9, yaw=1.57)) == pytest.approx(math.pi / 2), "it stands a second"
    assert task.heading_rad(state(0.3, 0.0, 26.1, yaw=1.57)) is None, "the right one is known to be a wall"
    assert place(task, seen(stub), state(0.3, 0.0, 26.5))[1] > 1.6, "what it saw there"
    assert place(task, layer, state(0.3, 0.0, 27.0)) == pytest.approx([2.4, 0.0], abs=0.1), "nothing: back to the end"
    assert not task.done(state(1.0, 0.0, 28.0))
    assert len(task.goals(layer, state(2.2, 0.0, 30.0))) == 0 and task.done(state(2.2, 0.0, 30.0))


def test_tracking_loss_ends_a_side_look():
    task, layer = FollowCorridor(), seen(stub, lambda x, y: (np.abs(y) > 0.9) & (x < 2.6))
    before_a_wall(task, layer)
    assert task.heading_rad(replace(state(0.3, 0.0, 25.0), tracked=False)) is None
    assert task.heading_rad(state(0.3, 0.0, 25.1)) is None
    assert place(task, layer, state(0.3, 0.0, 25.5)) == pytest.approx([2.4, 0.0], abs=0.1)


def test_narrowed_mouth_is_entered_unless_it_is_a_door():
    """The mouth is two metres wide, and one metre on the map."""
    layer = seen(lambda x, y: stub(x, y) | (np.abs(x) > 0.5) & (y > 0.8))
    door = Exit(np.array([0.0, 1.0, 1.15]), np.array([0.0, 1.0, 0.0]), 1.0, 0.1, 0.1, 2)
    may_be = Candidate(door.centre_w[:2], door.normal_w[:2], np.zeros((0, 2)))
    for candidates, exits, flies in (([], [], True), ([may_be], [], True), ([], [door], False)):
        task = FollowCorridor()
        task.consider(candidates, exits)
        for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
            found = task.goals(layer, state(x, 0.0, 0.5 * k))
        assert bool((layer.centres(found)[:, 1] > 1.6).any()) is flies


def test_closed_side_opening_leads_back_to_the_end():
    """An opening four metres back that turns out closed."""
    task, hole = FollowCorridor(), seen(lambda x, y: sides(end=3.0)(x, y) & ~((np.abs(x + 1.0) < 0.9) & (y > 0.0)))
    closed = seen(sides(end=3.0))
    hole = Layer(hole.free & closed.free, hole.solid, hole.corner_w, hole.cell_m)
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        found = task.goals(hole, state(x, 0.0, 0.5 * k))
    assert hole.centres(found)[0] == pytest.approx([-1.0, 1.2], abs=0.2)
    for x in (2.0, 1.5, 1.0, 0.5, 0.0, -0.5, -1.0):
        task.goals(hole, state(x, 0.0, 12.0 - x))
    assert place(task, closed, state(-1.0, 0.0, 14.0)) == pytest.approx([2.4, 0.0], abs=0.1)
    for k in range(6):  # slowly: a place that it comes to is not looked at in vain
        assert place(task, closed, state(1.3 + 0.1 * k, 0.0, 16.0 + k)) == pytest.approx([2.4, 0.0], abs=0.1)
        assert not task.done(state(1.3 + 0.1 * k, 0.0, 16.0 + k))
    assert len(task.goals(closed, state(2.2, 0.0, 24.0))) == 0, "a turn on the spot"
    assert not task.done(state(2.2, 0.0, 36.0))
    assert len(task.goals(closed, state(2.2, 0.0, 36.6))) == 0 and task.done(state(2.2, 0.0, 36.6))


def test_end_is_the_same_after_a_return():
    """The second apparent end is 0.4 m from the first."""
    task, hole = FollowCorridor(), seen(stub, lambda x, y: (y > 0.9) & (np.abs(x) < 1.0))
    shorter = seen(lambda x, y: sides(end=2.6)(x, y))
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        task.goals(hole, state(x, 0.0, 0.5 * k))
    for k, x in enumerate((2.0, 1.0, 0.5)):
        task.goals(hole, state(x, 0.0, 10.0 + k))
    assert place(task, seen(sides(end=5.6)), state(0.0, 0.0, 13.0))[0] > 4.0, "there is more to it than it seemed"
    assert place(task, shorter, state(1.9, 0.0, 15.0)) == pytest.approx([2.4, 0.0], abs=0.1)
    assert len(task.goals(shorter, state(2.2, 0.0, 16.0))) == 0


def test_unreachable_end_ends_the_task():
    task, layer = FollowCorridor(), seen(stub, lambda x, y: (y > 0.9) & (np.abs(x) < 1.0))
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        task.goals(layer, state(x, 0.0, 0.5 * k))
    lose(task, state(1.0, 0.0, 9.0))
    assert place(task, layer, state(1.0, 0.0, 13.0)) == pytest.approx([2.4, 0.0], abs=0.1)
    assert not task.done(state(1.0, 0.0, 13.0))
    task.goals(layer, state(1.0, 0.0, 34.0))
    assert task.done(state(1.0, 0.0, 34.0))


def lose(task, at):
    """The pose, for the third time, at a place."""
    for k in range(3):
        assert not task.done(replace(at, stamp_s=at.stamp_s + k))
        task.done(replace(at, stamp_s=at.stamp_s + k + 0.5, tracked=False, overridden=True))


def test_bare_wall_with_tracking_losses_ends_the_task():
    """The task is done, not stuck."""
    task, layer = FollowCorridor(), seen(stub, lambda x, y: (np.abs(y) > 0.9) & (x < 2.6))
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        task.goals(layer, state(x, 0.0, 0.5 * k))
    lose(task, state(1.9, 0.0, 9.0))
    assert task.done(state(1.9, 0.0, 12.0)) and task.wall


def test_tracking_loss_in_a_side_opening_leads_back_to_the_end():
    """The end is reached only there, not at the side opening."""
    task, layer = FollowCorridor(), seen(stub, lambda x, y: (y > 0.9) & (np.abs(x) < 1.0))
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        found = task.goals(layer, state(x, 0.0, 0.5 * k))
    assert layer.centres(found)[0] == pytest.approx([0.0, 1.2], abs=0.2)
    lose(task, state(0.0, 0.0, 9.0))
    assert place(task, layer, state(0.0, 0.0, 12.0)) == pytest.approx([2.4, 0.0], abs=0.1)
    assert not task.done(state(0.0, 0.0, 12.0))
    task.goals(layer, state(1.6, 0.0, 15.0))
    assert task.done(state(1.6, 0.0, 15.0))


def test_space_before_the_wall_is_no_continuation():
    """Otherwise the drone oscillates between a side opening and a last step to the wall."""
    layer, mouth = seen(stub, lambda x, y: (y > 0.9) & (np.abs(x) < 1.0)), pytest.approx([0.0, 1.2], abs=0.2)
    task, to_its_end = FollowCorridor(), [(x, 0.0) for x in np.arange(-4.0, 2.5, 0.4)]
    assert follow(task, layer, *to_its_end) == mouth
    assert place(task, layer, state(1.9, 0.0, 12.0)) == mouth
    task = FollowCorridor()
    assert follow(task, layer, *to_its_end[:-1])[0] > 2.3
    for k in range(12):
        found = task.goals(layer, state(2.0, 0.0, 10.0 + 0.5 * k))
    assert layer.centres(found)[0] == mouth, "it comes no nearer to the wall"


def test_it_moves_with_the_map():
    """Two metres to the left: the way flown stays the way flown, and what turns off what it flies to."""
    to = np.eye(4)
    to[1, 3] = 2.0
    for shape, left_m in ((stub, 3.6), (sides(end=3.0), math.nan)):
        task, views = FollowCorridor(), MapViews()
        views.add(0, np.eye(4))
        for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
            task.goals(seen(shape), replace(state(x, 0.0, 0.5 * k), views=views))
        views.correct(moved(0, to))
        there = seen(lambda x, y: shape(x, y - 2.0))  # noqa: B023
        found = there.centres(task.goals(there, state(2.4, 2.0, 30.0)))
        assert (found[:, 1] > left_m).all() if math.isfinite(left_m) else len(found) == 0


def test_a_corridor_ends_in_a_room():
    task, room = FollowCorridor(), seen(lambda x, y: np.maximum(np.abs(x), np.abs(y)) > 2.5)
    for k in range(5):
        task.goals(room, state(0.3 * k - 0.6, stamp_s=k))
        done = task.done(state(0.3 * k - 0.6, stamp_s=k))
    assert not done, "a metre must have been flown: a take-off in a room is no corridor's end"
    task.goals(room, state(0.6, stamp_s=5.0))
    task.goals(room, state(0.6, stamp_s=8.0))
    assert task.done(state(0.6, stamp_s=8.0)) and task.room


def test_unknown_space_beside_the_path_is_no_continuation():
    """Unseen ground half a metre behind the start, and nothing else to see: the far end is the goal."""
    layer = seen(lambda x, y: (np.abs(y) > 1.0) | (x > 4.0), lambda x, y: x < -0.5)
    task = FollowCorridor()
    assert place(task, layer, state(0.0))[0] > 3.0
    task.goals(layer, state(3.2, stamp_s=5.0))
    assert len(task.goals(layer, state(3.3, stamp_s=5.5))) == 0
