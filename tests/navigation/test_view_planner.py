"""What views show, from where they are taken, and exploration by them."""

import math
from dataclasses import replace

import numpy as np
import pytest
from views import longer

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapViews
from edgeslam_torch.navigation.openings.exit_tracker import Candidate
from edgeslam_torch.navigation.skills.explore import Explore
from edgeslam_torch.navigation.views import Coverage, Targets, ViewPlanner, borders

WALL = Targets(
    np.array([[x, 1.0] for x in np.arange(-3.0, 3.05, 0.1)]),
    np.tile([0.0, -1.0], (61, 1)),
    np.tile([0.6, 2.5], (61, 1)),
    np.full(61, math.cos(math.radians(40.0))),
    np.full(61, 0.1),
)
"""One metre to the left of a drone that flies along x."""
DOOR = Candidate(np.array([3.0, 0.0]), np.array([1.0, 0.0]), np.array([[1.5, 1.0]]))
"""In a wall across x; its left half was seen from one viewpoint."""


def at(x, y=0.0, yaw_deg=0.0, now_s=0.0, tracked=True, views=None):
    here = np.array([x, y, 1.15])
    return DroneState(now_s, here, math.radians(yaw_deg), np.zeros(3), tracked=tracked, views=views or MapViews())


def layer(free, solid=lambda x, y: np.zeros(x.shape, bool), low=(-2.0, -3.0), size=(80, 60)):
    x, y = np.meshgrid(*((np.arange(n) + 0.5) * 0.1 + c for n, c in zip(size, low, strict=True)), indexing="ij")
    is_solid = solid(x, y)
    return Layer(free(x, y) & ~is_solid, is_solid, np.array(low), 0.1)


def walled(inside):
    """Free inside, solid outside."""
    return layer(inside, lambda x, y: ~inside(x, y))


CORRIDOR = walled(lambda x, y: (np.abs(y) < 0.95) & (x > -1.0) & (x < 5.0))


def places(planner, of, state):
    """Viewpoints ``(G, 2)``."""
    return of.centres(planner.viewpoints(of, state)).reshape(-1, 2)


def look_around(planner, state, seconds=40.0):
    """Take the wanted views at 60 deg/s; the state afterwards and the headings [degrees]."""
    seen = []
    for _ in range(round(20 * seconds)):
        state = replace(state, stamp_s=state.stamp_s + 0.05)
        if (look := planner.taking(state)) is None and not planner.look_around(state):
            break
        error = 0.0 if look is None else state.turn_to_rad(look.heading_rad)
        state = replace(state, yaw_rad=state.yaw_rad + float(np.clip(error, -0.05, 0.05)))
        seen.append((math.degrees(state.yaw_rad) + 180.0) % 360.0 - 180.0)
    return state, np.array(seen)


def test_a_view_covers_what_lies_within_twenty_degrees_ahead():
    coverage = Coverage()
    coverage.note(at(0.0, 0.0, 90.0))
    reach = math.tan(math.radians(20.0))
    np.testing.assert_allclose(
        coverage.unlooked(WALL).p_w[:, 0], [x for x in WALL.p_w[:, 0] if abs(x) > reach], atol=1e-9
    )


@pytest.mark.parametrize(
    "state",
    [
        pytest.param(at(-2.0, 0.0, 18.0), id="along the wall"),
        pytest.param(at(0.0, 0.0, -90.0), id="away from it"),
        pytest.param(at(0.0, 2.0, -90.0), id="from behind it"),
        pytest.param(at(0.0, 0.45, 90.0), id="from so near that a door does not fit"),
        pytest.param(at(0.0, -1.6, 90.0), id="from afar"),
        pytest.param(at(0.0, 0.0, 90.0, tracked=False), id="by telemetry"),
    ],
)
def test_other_views_cover_nothing(state):
    coverage = Coverage()
    coverage.note(state)
    assert len(coverage.unlooked(WALL).p_w) == len(WALL.p_w)


def test_borders_face_the_free_space():
    found = borders(CORRIDOR, np.zeros(2))
    long = (found.p_w[:, 0] > 0.0) & (found.p_w[:, 0] < 4.0)
    np.testing.assert_allclose(np.abs(found.p_w[long, 1]), 0.95, atol=0.11)
    assert (found.normal_w[long] @ [0.0, 1.0] * -np.sign(found.p_w[long, 1])).min() > 0.99
    assert long.sum() == pytest.approx(2 * 40, abs=4)


def test_furniture_and_other_rooms_are_no_borders():
    chair = layer(lambda x, y: np.abs(y) < 0.95, lambda x, y: (np.abs(x - 1.0) < 0.2) & (np.abs(y) < 0.2))
    assert np.linalg.norm(borders(chair, np.zeros(2)).p_w - [1.0, 0.0], axis=1).min() > 0.6
    beyond = layer(lambda x, y: (np.abs(y) < 0.95) | ((y > 1.5) & (y < 2.5)))
    assert borders(beyond, np.zeros(2)).p_w[:, 1].max() < 1.1
    assert borders(beyond, np.array([0.0, 2.0])).p_w[:, 1].min() > 1.2
    assert len(borders(layer(lambda x, y: np.zeros(x.shape, bool)), np.zeros(2)).p_w) == 0


def test_unknown_space_is_viewed_from_nearer_than_a_wall():
    half = layer(lambda x, y: (x < 3.0) & (np.abs(y) < 1.45), lambda x, y: np.abs(y) >= 1.45)
    found = borders(half, np.zeros(2))
    unknown = (np.abs(found.p_w[:, 0] - 3.0) < 0.2) & (np.abs(found.p_w[:, 1]) < 1.0)
    wall = (found.p_w[:, 0] < 2.0) & (np.abs(found.p_w[:, 1]) > 1.3)
    assert found.range_m[unknown, 1].max() < found.range_m[wall, 1].min()


def test_walls_on_both_sides_are_viewed_frontally_and_once():
    planner = ViewPlanner(0.15)
    planner.viewpoints(CORRIDOR, at(2.0))
    state, seen = look_around(planner, at(2.0))
    for side in (1.0, -1.0):
        assert (np.abs(side * seen - 90.0) < 8.0).any()
    assert len(seen) < 20 * 15
    planner.viewpoints(CORRIDOR, state)
    assert not planner.look_around(replace(state, p_w=np.array([2.1, 0.0, 1.15])))


def test_viewpoints_cover_all_borders():
    planner, state, stands = ViewPlanner(0.15), at(0.0), 0
    for _ in range(25):
        found = places(planner, CORRIDOR, state)
        state, seen = look_around(planner, state)
        stands += len(seen) > 0
        if len(found := places(planner, CORRIDOR, state)) == 0:
            break
        assert np.abs(found[:, 1]).max() < 0.65, "thirty centimetres from a wall at least"
        best = found[np.abs(found[:, 0] - state.p_w[0]).argmin()]
        state = replace(state, p_w=np.array([*best, 1.15]))
    assert 3 <= stands < 15
    left = planner._left.p_w
    assert ((np.abs(left[:, 0] - 2.0) < 2.5) & (np.abs(left[:, 1]) < 1.1)).sum() * 0.1 < 2.0, "of ten metres of wall"


def test_a_lost_pose_and_a_drone_that_does_not_turn_end_a_look_around():
    planner = ViewPlanner(0.15)
    planner.viewpoints(CORRIDOR, at(2.0))
    assert planner.look_around(at(2.0)) and planner.look is not None
    assert planner.taking(at(2.0, now_s=0.1, tracked=False)) is None
    assert not planner.look_around(at(2.0, now_s=0.2))
    stuck = ViewPlanner(0.15)
    stuck.viewpoints(CORRIDOR, at(2.0))
    for k in range(1200):
        state = at(2.0, now_s=0.1 * k)
        if stuck.taking(state) is None and not stuck.look_around(state):
            break
    assert k < 1199


def test_looks_around_follow_map_corrections():
    """Metres become twice as long: where it has looked around, 2 m from its take-off, is 4 m from it."""
    planner, views = ViewPlanner(0.15), MapViews()
    planner.viewpoints(CORRIDOR, at(2.0, views=views))
    assert look_around(planner, at(2.0, views=views))[1].size
    planner._coverage = Coverage()
    views.correct(longer(2.0))
    planner.viewpoints(CORRIDOR, at(4.1, views=views))
    assert not planner.look_around(at(4.1, views=views))
    assert planner.look_around(at(2.0, views=views))


def room(solid=lambda x, y: np.zeros(x.shape, bool)):
    """Six metres by six around the door; its wall at x of 3; nothing was covered but for the door."""
    wall = lambda x, y: (np.abs(x - 3.0) < 0.1) & (np.abs(y) > 0.45)  # noqa: E731
    return layer(lambda x, y: x > 0.0, lambda x, y: wall(x, y) | solid(x, y), (0.0, -3.0), (60, 60))


class Covered:
    """All borders were covered."""

    def unlooked(self, all_):
        return all_[np.zeros(0, int)]

    def note(self, state):
        pass


def considering(*openings):
    return ViewPlanner(0.15, openings=openings, _coverage=Covered())


def test_viewpoints_are_before_an_opening_and_away_from_earlier_ones():
    found = places(considering(DOOR), room(), at(0.5, 2.5))
    assert len(found)
    before = 3.0 - found[:, 0]
    assert before.min() >= 0.75 and before.max() <= 2.5, "on the side from which it was seen, and not from afar"
    assert (np.abs(found[:, 1]) <= before).all(), "not along the wall"
    assert np.linalg.norm(found - DOOR.saturated_w[0], axis=1).min() >= 0.5


def test_unreachable_viewpoints_are_excluded():
    assert len(places(considering(DOOR), room(lambda x, y: np.abs(x - 0.3) < 0.2), at(0.1, 2.5))) == 0


def test_an_opening_is_looked_at_once_from_a_place():
    planner = considering(DOOR)
    assert not planner.look_around(at(1.5, 1.0)), "from where it was seen"
    state, seen = look_around(planner, at(1.8, -0.3, 90.0))
    assert seen[-1] == pytest.approx(math.degrees(math.atan2(0.3, 1.2)), abs=15.0)
    assert not planner.look_around(state)
    found = places(planner, room(), state)
    assert len(found) and np.linalg.norm(found - [1.8, -0.3], axis=1).min() > 0.4


def test_exploration_visits_frontiers_walls_and_openings_and_ends():
    """A drone that is at its goal at once; of the border of the unseen it sees no more."""
    half = layer(lambda x, y: (x < 5.0) & (np.abs(y) < 2.9), low=(0.0, -3.0), size=(60, 60))
    task, planner, state = Explore(), ViewPlanner(0.15), at(2.0)
    visited = [state.p_w[:2]]
    for _ in range(8000):
        state = replace(state, stamp_s=state.stamp_s + 0.1)
        if task.result(state):
            break
        if (look := planner.taking(state)) is not None:
            turn = np.clip(state.turn_to_rad(look.heading_rad), -0.1, 0.1)
            state = replace(state, yaw_rad=state.yaw_rad + float(turn))
        elif not task.looks(state, planner) and len(cells := task.goals(half, state, planner)):
            found = half.centres(cells)
            state = replace(state, p_w=np.array([*found[np.hypot(*(found - state.p_w[:2]).T).argmin()], 1.15]))
            visited.append(state.p_w[:2])
    assert task.result(state).reached
    assert np.max(visited, axis=0)[0] > 3.8, "near the border of what was never seen"
    planner.viewpoints(half, state)
    assert len(planner._left.p_w) * 0.1 < 4.0, "of 22 m of border"


def test_exploration_goes_on_while_there_is_an_opening_to_look_at():
    """All is known and covered: it would end after a look around."""
    task, planner = Explore(), considering()
    for now_s in np.arange(0.0, 20.0, 0.5):
        planner.openings = [DOOR] * int(now_s > 5.0)
        assert (len(task.goals(room(), at(0.5, 1.0, now_s=now_s), planner)) > 0) == (now_s > 5.0)
        assert not task.result(at(0.5, 1.0, now_s=now_s))


def test_exploration_does_not_end_while_the_supervisor_flies():
    """It shows nothing new meanwhile, as when the scale is awaited after the take-off."""
    task, planner = Explore(), considering()
    for now_s in np.arange(0.0, 40.0, 0.5):
        state = replace(at(0.5, 1.0, now_s=now_s), overridden=now_s < 20.0)
        assert not len(task.goals(room(), state, planner))
        assert bool(task.result(state)) == (now_s > 32.0)
