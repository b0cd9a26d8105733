"""Following a corridor, against corridors whose walls are known."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.navigation.corridor.corridor_geometry import mouths
from edgeslam_torch.navigation.corridor.follow import FollowCorridor
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.navigation.openings.exit_tracker import Candidate, Exit


def seen(is_solid, is_unseen=lambda x, y: np.zeros(x.shape, bool)):
    """A square of 12 m around the origin."""
    x, y = np.meshgrid((np.arange(120) + 0.5) * 0.1 - 6.0, (np.arange(120) + 0.5) * 0.1 - 6.0, indexing="ij")
    solid, unseen = is_solid(x, y), is_unseen(x, y)
    return Layer(~solid & ~unseen, solid & ~unseen, np.array([-6.0, -6.0]), 0.1)


def state(x, y=0.0, stamp_s=0.0, yaw=0.0):
    return DroneState(stamp_s, np.array([x, y, 1.15]), yaw, np.zeros(3))


def place(task, layer, at):
    """Where it wants to go ``(2,)``."""
    (cell,) = task.goals(layer, at)
    return layer.centres(cell)


def follow(task, layer, *way):
    """Where it wants to go at the end of a way."""
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


def test_what_is_unseen_behind_the_start_is_where_it_came_from():
    """Two metres behind it, which is not beside its way: at the end of the corridor it does not turn back to it."""
    layer = seen(lambda x, y: (np.abs(y) > 1.0) | (x > 4.0), lambda x, y: x < -2.0)
    task = FollowCorridor()
    task.goals(layer, state(0.0))
    assert len(task.goals(layer, state(3.3, stamp_s=5.0))) == 0


@pytest.mark.parametrize("width", [2.0, 2.4])
def test_the_corridor_flown_along_one_side_is_no_way_on(width):
    layer = seen(sides(width), lambda x, y: np.abs(y - 0.5 * width + 0.1) < 0.1)
    way = [(x, 0.6 - 0.5 * width) for x in np.arange(-4.0, 4.7, 0.4)]
    task = FollowCorridor()
    for k, (x, y) in enumerate(way):
        found = task.goals(layer, state(x, y, 0.5 * k))
    assert len(found) == 0, "a turn on the spot at the end"


def test_an_end_is_something_solid_ahead_not_the_lack_of_a_way():
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


def test_what_is_narrow_straight_ahead_is_flown_through_unless_it_is_a_door():
    """Depth that is too near makes a corridor as narrow as a door for half a metre."""
    narrow = seen(lambda x, y: sides()(x, y) | (np.abs(x - 2.0) < 0.3) & (np.abs(y) > 0.4))
    way = [(x, 0.0) for x in (-1.0, -0.5, 0.0, 0.5, 1.0, 1.3)]
    assert follow(FollowCorridor(), narrow, *way)[0] > 4.0
    ahead, to_the_left = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    for middle, normal, far in ((1.8, ahead, False), (1.8, to_the_left, True), (-3.0, ahead, True)):
        task = FollowCorridor()
        task.consider([Candidate(np.array([middle, 0.2]), normal, np.array([0.0, 0.0]))])
        last = follow(task, narrow, *[(x, 0.0) for x in (-1.0, -0.5, 0.0, 0.5)], (1.0, 0.0))
        assert bool(last[0] > 4.0) is far
    task, wide = FollowCorridor(), np.array([1.8, 0.2, 1.15])
    task.consider([], [Exit(wide, np.array([1.0, 0.0, 0.0]), 0.9, 0.1, 0.1, 2)])
    assert follow(task, narrow, *[(x, 0.0) for x in (-1.0, -0.5, 0.0, 0.5)], (1.0, 0.0))[0] < 1.8


def test_a_speck_beside_the_start_does_not_end_it():
    """`blank_walls` 812: what is wide and free begins farther than a metre away."""
    speck = lambda x, y: (np.abs(x - 0.4) < 0.1) & (np.abs(y - 0.5) < 0.1)  # noqa: E731
    layer = seen(lambda x, y: sides()(x, y) | speck(x, y) | (x < 0.7) & (y < -0.5))
    assert place(FollowCorridor(), layer, state(0.0))[0] > 3.0


def test_where_nothing_is_known_ahead_it_wants_to_go_ahead():
    nothing = seen(lambda x, y: np.abs(y) > 1.0, lambda x, y: np.abs(x) > 0.3)
    assert place(FollowCorridor(), nothing, state(0.0)) == pytest.approx([1.5, 0.0], abs=0.1)
    assert len(FollowCorridor().goals(seen(lambda x, y: x > 1.2, lambda x, y: np.abs(x) > 0.3), state(0.0)))
    assert len(FollowCorridor().goals(seen(sides(end=0.9)), state(0.4))) == 0


def test_a_drone_that_is_brought_back_goes_on_ahead():
    """Its pose was lost, and the supervisor flew it back along its way."""
    layer = seen(sides(), lambda x, y: x > 4.0)
    way = [(x, 0.0) for x in np.arange(-4.0, 2.1, 0.5)]
    assert follow(FollowCorridor(), layer, *way, (1.0, 0.1), (0.0, 0.0), (-1.0, 0.0))[0] > 3.0


ALONG_X = np.array([[x, 0.0] for x in range(3)])
"""A way, a metre from place to place."""


def stub(x, y):
    """A corridor of 2 m that ends at 3 m; from -1 to 1 m another leads to the left."""
    return ~((np.abs(y) < 1.0) & (x < 3.0) | (np.abs(x) < 1.0) & (y > 0.0))


def test_from_a_dead_end_it_comes_back_to_what_turns_off():
    task, layer = FollowCorridor(), seen(stub)
    to_its_end = [(x, 0.0) for x in np.arange(-4.0, 2.3, 0.4)]
    assert follow(task, layer, *to_its_end)[1] > 1.6
    for x in (1.6, 1.0, 0.5, 0.1):
        assert place(task, layer, state(x, 0.1, 20.0 - x))[1] > 1.6, "not into the dead end again"
    for y in (0.6, 1.2, 1.8):
        last = place(task, layer, state(0.0, y, 30.0 + y))
    assert last == pytest.approx([0.0, 5.4], abs=0.4), "ahead is where it flies now"


def test_what_turns_off_is_flown_to_as_soon_as_its_mouth_is_seen():
    """`l_corridor` 811: of it a drone sees, from its dead end, a tongue of half a metre's width."""
    mouth = lambda x, y: (np.abs(x) < 0.9) & (y < 1.2) | (np.abs(x - 0.3 + 0.5 * (y - 1.0)) < 0.2) & (y < 1.8)  # noqa: E731
    layer = seen(stub, lambda x, y: (y > 0.9) & ~mouth(x, y))
    last = follow(FollowCorridor(), layer, *[(x, -0.2) for x in np.arange(-4.0, 2.3, 0.4)])
    assert last == pytest.approx([0.0, 1.6], abs=0.3)


def test_before_a_wall_it_looks_into_the_holes_in_the_sides():
    """`l_corridor` 812: in passing nothing of what turns off was seen but that no wall is there."""
    layer = seen(stub, lambda x, y: (y > 0.9) & (np.abs(x) < 1.0))
    to_its_end = [(x, 0.0) for x in np.arange(-4.0, 2.5, 0.4)]
    assert follow(FollowCorridor(), layer, *to_its_end) == pytest.approx([0.0, 1.2], abs=0.2)
    specks = seen(lambda x, y: stub(x, y) | (np.abs(x) < 0.1) & (np.abs(y - 0.6) < 0.1), lambda x, y: y > 2.0)
    assert len(mouths(specks, np.array([2.4, 0.0]), np.array([1.0, 0.0]), ALONG_X)) == 1, "`l_corridor` 816"
    door = seen(lambda x, y: (np.abs(y) > 1.0) & ((np.abs(x) > 0.5) | (y < 0.0)) | (x > 3.0), lambda x, y: y > 1.1)
    assert len(mouths(door, np.array([2.4, 0.0]), np.array([1.0, 0.0]), ALONG_X)) == 0, "a door is none"


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_the_corridor_that_it_came_from_is_no_hole_in_the_side(side):
    """`l_corridor` 830: from the end of the other corridor it flew back to the dead end."""
    layer = seen(stub, lambda x, y: (np.abs(x) < 1.0) & (y < -2.0))
    end, axis = np.array([0.0, 4.0]), np.array([0.0, 1.0])
    for past in (0.0, 0.8 * side):
        way = np.stack([np.full(5, past), np.arange(5.0)], 1)
        assert len(mouths(layer, end, axis, way)) == 2, "flown past, not through"
    to_the_dead_end = ALONG_X * [side, 1.0] + [0.0, 0.4]
    assert layer.centres(mouths(layer, end, axis, to_the_dead_end))[:, 0] * side == pytest.approx([-1.2], abs=0.1)


def before_a_wall(task, layer):
    """At the dead end of the stub for as long as a turn takes, and on to where it looks to the sides: what it wants."""
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        found = task.goals(layer, state(x, 0.0, 0.5 * k))
    assert len(found) == 0, "a turn on the spot first"
    wanted = place(task, layer, state(2.4, 0.0, 20.6))
    for x in (2.0, 1.6, 1.2, 0.8, 0.3):
        assert task.heading_rad(state(x, 0.0, 24.0 - x)) is None, "not there yet"
        task.goals(layer, state(x, 0.0, 24.0 - x))
    return wanted


def test_sides_that_are_not_known_to_be_walls_are_looked_at_before_it_ends():
    """`l_corridor` 816 and 817: nothing at all was seen of what turns off."""
    layer, task = seen(stub, lambda x, y: (y > 0.9) & (x < 2.6)), FollowCorridor()
    assert before_a_wall(task, layer) == pytest.approx([0.2, 0.0], abs=0.1)
    assert task.heading_rad(state(0.3, 0.0, 25.0)) == pytest.approx(math.pi / 2)
    assert task.heading_rad(state(0.3, 0.0, 25.9, yaw=1.57)) == pytest.approx(math.pi / 2), "it stands a second"
    assert task.heading_rad(state(0.3, 0.0, 26.1, yaw=1.57)) is None, "the right one is known to be a wall"
    assert place(task, seen(stub), state(0.3, 0.0, 26.5))[1] > 1.6, "what it saw there"
    assert place(task, layer, state(0.3, 0.0, 27.0)) == pytest.approx([2.4, 0.0], abs=0.1), "nothing: back to the end"
    assert not task.done(state(1.0, 0.0, 28.0))
    assert len(task.goals(layer, state(2.2, 0.0, 30.0))) == 0 and task.done(state(2.2, 0.0, 30.0))


def test_a_look_to_the_side_ends_with_the_pose():
    task, layer = FollowCorridor(), seen(stub, lambda x, y: (np.abs(y) > 0.9) & (x < 2.6))
    before_a_wall(task, layer)
    assert task.heading_rad(replace(state(0.3, 0.0, 25.0), tracked=False)) is None
    assert task.heading_rad(state(0.3, 0.0, 25.1)) is None
    assert place(task, layer, state(0.3, 0.0, 25.5)) == pytest.approx([2.4, 0.0], abs=0.1)


def test_a_mouth_that_depth_has_made_narrow_is_flown_into_unless_it_is_a_door():
    """`l_corridor` 822: two metres wide, and one metre on the map."""
    layer = seen(lambda x, y: stub(x, y) | (np.abs(x) > 0.5) & (y > 0.8))
    door = Exit(np.array([0.0, 1.0, 1.15]), np.array([0.0, 1.0, 0.0]), 1.0, 0.1, 0.1, 2)
    may_be = Candidate(door.centre_w[:2], door.normal_w[:2], np.array([-1.0, 0.0]))
    for candidates, exits, flies in (([], [], True), ([may_be], [], True), ([], [door], False)):
        task = FollowCorridor()
        task.consider(candidates, exits)
        for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
            found = task.goals(layer, state(x, 0.0, 0.5 * k))
        assert bool((layer.centres(found)[:, 1] > 1.6).any()) is flies


def test_from_a_hole_that_is_none_it_comes_back_to_the_end():
    """`blank_walls` 828: a hole four metres back, which closed as it was looked into."""
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


def test_an_end_that_was_come_back_to_is_the_one_that_it_was():
    """`corridor` 832: it had been 1.2 m before the door, and ended 1.6 m before it, after another turn."""
    task, hole = FollowCorridor(), seen(stub, lambda x, y: (y > 0.9) & (np.abs(x) < 1.0))
    shorter = seen(lambda x, y: sides(end=2.6)(x, y))
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        task.goals(hole, state(x, 0.0, 0.5 * k))
    for k, x in enumerate((2.0, 1.0, 0.5)):
        task.goals(hole, state(x, 0.0, 10.0 + k))
    assert place(task, seen(sides(end=5.6)), state(0.0, 0.0, 13.0))[0] > 4.0, "there is more to it than it seemed"
    assert place(task, shorter, state(1.9, 0.0, 15.0)) == pytest.approx([2.4, 0.0], abs=0.1)
    assert len(task.goals(shorter, state(2.2, 0.0, 16.0))) == 0


def test_a_way_back_to_the_end_that_there_is_none_of_ends_it():
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


def test_a_bare_wall_before_which_the_pose_is_lost_ends_it():
    """`l_corridor` 823: at the end of it, and "no way"."""
    task, layer = FollowCorridor(), seen(stub, lambda x, y: (np.abs(y) > 0.9) & (x < 2.6))
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        task.goals(layer, state(x, 0.0, 0.5 * k))
    lose(task, state(1.9, 0.0, 9.0))
    assert task.done(state(1.9, 0.0, 12.0)) and task.wall


def test_where_the_pose_is_lost_looking_into_a_hole_it_comes_back_to_the_end():
    """`corridor` 830: it had been before the door, looked into a hole in a bare wall, and landed there."""
    task, layer = FollowCorridor(), seen(stub, lambda x, y: (y > 0.9) & (np.abs(x) < 1.0))
    for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
        found = task.goals(layer, state(x, 0.0, 0.5 * k))
    assert layer.centres(found)[0] == pytest.approx([0.0, 1.2], abs=0.2)
    lose(task, state(0.0, 0.0, 9.0))
    assert place(task, layer, state(0.0, 0.0, 12.0)) == pytest.approx([2.4, 0.0], abs=0.1)
    assert not task.done(state(0.0, 0.0, 12.0))
    task.goals(layer, state(1.6, 0.0, 15.0))
    assert task.done(state(1.6, 0.0, 15.0))


def test_what_is_between_it_and_the_wall_is_no_way_on():
    """`l_corridor` 817 and 818: between a hole in the side and a last step to the wall it stayed where it was."""
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
    from_, to = np.eye(4)[None], np.eye(4)[None]
    to[0, 1, 3] = 2.0
    for shape, left_m in ((stub, 3.6), (sides(end=3.0), math.nan)):
        task = FollowCorridor()
        for k, x in enumerate(np.arange(-4.0, 2.5, 0.4)):
            task.goals(seen(shape), state(x, 0.0, 0.5 * k))
        task.carry(MapUpdate(from_, to))
        moved = seen(lambda x, y: shape(x, y - 2.0))  # noqa: B023
        found = moved.centres(task.goals(moved, state(2.4, 2.0, 30.0)))
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


def test_what_is_unseen_beside_the_way_is_no_way_on():
    """Unseen ground half a metre behind the start, and nothing else to see: the far end is the goal."""
    layer = seen(lambda x, y: (np.abs(y) > 1.0) | (x > 4.0), lambda x, y: x < -0.5)
    task = FollowCorridor()
    assert place(task, layer, state(0.0))[0] > 3.0
    task.goals(layer, state(3.2, stamp_s=5.0))
    assert len(task.goals(layer, state(3.3, stamp_s=5.5))) == 0
