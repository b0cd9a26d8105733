"""Viewpoints and headings of exploration."""

import math

import numpy as np
import pytest
from views import longer

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.coverage import Borders
from edgeslam_torch.navigation.exploring.view_planner import ViewPlanner, _in_turn
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapViews
from edgeslam_torch.navigation.openings.exit_tracker import Candidate
from edgeslam_torch.navigation.skills.explore import Explore


def at(now_s, x, yaw_deg, tracked=True):
    here = np.array([x, 0.0, 1.15])
    return DroneState(now_s, here, math.radians(yaw_deg), np.zeros(3), tracked=tracked, views=VIEWS)


VIEWS = MapViews()
NO_FRONTIER = np.zeros((0, 2), int)


def corridor(long_m=6.0):
    """Two metres wide, from 1 m behind the drone to where it ends."""
    x, y = np.meshgrid((np.arange(100) + 0.5) * 0.1 - 2.0, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    free = (np.abs(y) < 0.95) & (x > -1.0) & (x < long_m)
    return Layer(free, ~free, np.array([-2.0, -3.0]), 0.1)


CORRIDOR = corridor()


def asked(looks, x, now_s=0.0, layer=CORRIDOR):
    """Places ``(G, 2)`` from which to look."""
    return layer.centres(looks.goals(layer, at(now_s, x, 0.0), NO_FRONTIER)).reshape(-1, 2)


def looked(looks, x, yaw_deg=0.0, begin_s=0.0, seconds=20.0, turns=True):
    """Headings [degrees] of a drone that follows the requested headings at 60 deg/s."""
    seen = []
    asked(looks, x, begin_s)
    for k in range(round(20 * seconds)):
        wanted = looks.heading_rad(at(begin_s + k / 20, x, yaw_deg))
        if wanted is None:
            break
        error = (math.degrees(wanted) - yaw_deg + 180.0) % 360.0 - 180.0
        yaw_deg += float(np.clip(error, -3.0, 3.0)) if turns else 0.0
        seen.append((yaw_deg + 180.0) % 360.0 - 180.0)
    return seen


def test_walls_on_both_sides_are_viewed_frontally():
    seen = np.array(looked(ViewPlanner(), 2.0))
    for side in (1.0, -1.0):
        assert (np.abs(side * seen - 90.0) < 8.0).any(), "a door beside the corridor comes to the picture's middle"
    assert len(seen) < 20 * 10, "in less than ten seconds"


def test_covered_borders_are_not_viewed_again():
    looks = ViewPlanner()
    assert looked(looks, 2.0)
    looks.goals(CORRIDOR, at(30.0, 2.0, 0.0), NO_FRONTIER)
    left = looks._left.p_w
    beside = (np.abs(left[:, 0] - 2.0) < 0.9) & (np.abs(left[:, 1]) < 1.1)
    assert beside.sum() * 0.1 < 0.4, "of four metres of wall"
    assert not looked(looks, 2.1, begin_s=40.0), "and there it does not stand again"


def test_viewpoints_cover_all_borders_greedily():
    looks, x, stands = ViewPlanner(), 0.0, 0
    for k in range(20):
        looked(looks, x, begin_s=30.0 * k)
        if len(places := asked(looks, x, 30.0 * k + 20.0)) == 0:
            break
        assert np.abs(places[:, 1]).max() < 0.65, "thirty centimetres from a wall at least"
        x, stands = float(places[np.argmin(np.abs(places[:, 0] - x)), 0]), stands + 1
    assert 3 <= stands < 12
    left = looks._left.p_w
    sides = (np.abs(left[:, 0] - 2.5) < 2.5) & (np.abs(left[:, 1]) < 1.1)
    assert sides.sum() * 0.1 < 2.0, "of ten metres of wall beside the way"


def test_a_view_ahead_alone_is_looked_at_only_if_there_is_a_doors_width_of_it():
    looks = ViewPlanner()
    assert looks.heading_rad(at(0.0, 2.0, 0.0)) is None, "nothing is known yet"
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    small = Layer(np.hypot(x - 2.0, y) < 0.5, np.zeros(x.shape, bool), np.array([0.0, -3.0]), 0.1)
    looks.goals(small, at(0.1, 2.0, 0.0), NO_FRONTIER)
    assert looks.heading_rad(at(0.2, 2.0, 0.0)) is None, "all is nearer than a door fits into a picture"


def test_viewpoint_without_success_is_not_repeated():
    looks = ViewPlanner()
    best = asked(looks, 2.0)[0]
    looked(looks, float(best[0]), turns=False)
    places = asked(looks, float(best[0]), 30.0)
    assert len(places) and np.linalg.norm(places - [best[0], 0.0], axis=1).min() > 0.4


@pytest.mark.parametrize(("cells", "stands"), [(4, False), (8, True)])
def test_less_than_a_doors_width_of_wall_is_no_reason_to_stand(cells, stands):
    looks = ViewPlanner()
    looks._left = Borders(np.array([[2.0 + 0.1 * k, 1.0] for k in range(cells)]), np.tile([0.0, -1.0], (cells, 1)), 0.1)
    assert (looks.heading_rad(at(0.0, 2.2, 0.0)) is not None) == stands


def test_a_lost_pose_and_a_drone_that_does_not_turn_end_it():
    looks = ViewPlanner()
    asked(looks, 2.0)
    assert looks.heading_rad(at(0.0, 2.0, 0.0)) is not None
    assert looks.heading_rad(at(0.1, 2.0, 0.0, tracked=False)) is None
    assert looks.heading_rad(at(0.2, 2.0, 0.0)) is None
    assert len(looked(ViewPlanner(), 2.0, seconds=20.0, turns=False)) == pytest.approx(320, abs=2)


def test_positions_follow_map_corrections():
    """Metres become twice as long: where it has looked around, 2 m from its take-off, is 4 m from it."""
    looks = ViewPlanner()
    assert looked(looks, 2.0)
    VIEWS.correct(longer(2.0))
    assert not looked(looks, 4.1, begin_s=30.0)
    assert looked(looks, 2.0, begin_s=60.0)


def test_headings_follow_each_other_the_short_way_round():
    assert _in_turn([math.radians(a) for a in (-100.0, 160.0, 60.0)]) == pytest.approx(
        [math.radians(a) for a in (60.0, 160.0, -100.0)]
    )
    assert _in_turn([]) == []


DOOR = Candidate(np.array([3.0, 0.0]), np.array([1.0, 0.0]), np.array([[1.5, 1.0]]))
"""In a wall across x; its left half was seen from one viewpoint."""


def beside(x, y, now_s=0.0):
    return DroneState(now_s, np.array([x, y, 1.15]), 0.0, np.zeros(3), views=VIEWS)


def room(solid=None):
    """Six metres by six around the door; its wall at x of 3."""
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    is_solid = (np.abs(x - 3.0) < 0.1) & (np.abs(y) > 0.45)
    is_solid |= solid(x, y) if solid else False
    return Layer(~is_solid, is_solid, np.array([0.0, -3.0]), 0.1)


class Covered:
    """Borders all of which were covered."""

    def unlooked(self, all_):
        return all_[np.zeros(0, int)]

    def note(self, state):
        pass


def considering(*openings):
    planner = ViewPlanner(_coverage=Covered())
    planner.consider(openings)
    return planner


def wanted(planner, layer, here=(0.5, 2.5), now_s=0.0):
    return layer.centres(planner.goals(layer, beside(*here, now_s), NO_FRONTIER)).reshape(-1, 2)


def test_viewpoints_before_an_opening_on_the_way_come_first():
    near = wanted(considering(DOOR), room(), (1.2, -0.5))
    assert len(near)
    assert np.linalg.norm(near - [1.2, -0.5], axis=1).max() <= 1.2
    planner, far = considering(DOOR), np.array([[5, 55]])
    assert far.tolist() == planner.goals(room(), beside(0.5, 2.5), far)[:1].tolist()
    assert far.tolist() != planner.goals(room(), beside(1.2, -0.5), far)[:1].tolist()


def test_viewpoints_are_before_an_opening_and_away_from_earlier_ones():
    places, planner = wanted(considering(DOOR), room()), considering(DOOR)
    assert len(places)
    for place in places:
        for angle in np.arange(0.0, 6.3, 0.4):
            near = place + 0.13 * np.array([math.cos(angle), math.sin(angle)])
            assert planner.heading_rad(beside(*near)) is not None, "a planner comes within fifteen centimetres"
    before = 3.0 - places[:, 0]
    assert before.min() >= 0.8
    assert before.max() <= 2.0, "on the side from which it was seen, and not from afar"
    assert (np.abs(places[:, 1]) <= 0.3 * before).all(), "not along the wall"
    assert np.linalg.norm(places - DOOR.saturated_w[0], axis=1).min() >= 0.6


def test_unreachable_viewpoints_are_excluded():
    fence = room(lambda x, y: np.abs(x - 0.8) < 0.1)
    assert len(wanted(considering(DOOR), fence)) == 0
    table = room(lambda x, y: (np.abs(x - 1.3) < 0.1) & (np.abs(y) < 0.1))
    assert np.abs(wanted(considering(DOOR), table) - [1.3, 0.0]).max(1).min() > 0.3


def test_it_hovers_and_views_an_opening_until_views_add_no_information():
    planner = considering(DOOR)
    assert planner.heading_rad(beside(1.5, 1.0)) is None, "from where it was seen"
    assert planner.heading_rad(beside(1.8, -0.3, 1.0)) == pytest.approx(math.atan2(0.3, 1.2))
    planner.consider([Candidate(DOOR.centre_w, DOOR.normal_w, np.array([[1.8, -0.3]]))])
    assert planner.heading_rad(beside(1.8, -0.3, 2.0)) is None


def test_a_look_at_an_opening_ends_and_is_not_repeated_there():
    planner = considering(DOOR)
    assert planner.heading_rad(beside(1.8, -0.3, 1.0)) is not None
    assert planner.heading_rad(beside(1.8, -0.3, 4.9)) is not None
    assert planner.heading_rad(beside(1.8, -0.3, 5.1)) is None
    places = wanted(planner, room(), now_s=5.2)
    assert len(places) and np.linalg.norm(places - [1.8, -0.3], axis=1).min() > 0.4
    other = Candidate(np.array([3.0, -2.0]), DOOR.normal_w, np.zeros((0, 2)))
    planner.consider([other])
    assert len(wanted(planner, room(), now_s=42.0)), "another one is not"


def test_viewpoints_that_are_never_reached_are_given_up():
    planner, layer = considering(DOOR), room()
    for k in range(100):
        if len(wanted(planner, layer, now_s=float(k * 31))) == 0:
            break
    assert 1 < k < 20


def test_looks_at_openings_follow_map_corrections():
    """Metres become twice as long: what was given up at 3 m is at 6."""
    planner = considering(DOOR)
    planner.heading_rad(beside(1.8, -0.3, 0.0))
    planner.heading_rad(beside(1.8, -0.3, 5.0))
    VIEWS.correct(longer(2.0))
    planner.consider([Candidate(np.array([5.0, -0.6]), DOOR.normal_w, np.zeros((0, 2)))])
    assert planner.heading_rad(beside(3.6, -0.6, 6.0)) is None
    assert planner.heading_rad(beside(3.1, -0.6, 7.0)) is not None


def plain(end_m=9.0, corner=False):
    """A room of six metres by six; what is beyond ``end_m`` was not seen, nor is a corner behind something."""
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    unseen = (np.abs(x - 3.0) < 0.5) & (np.abs(y - 2.2) < 0.5) if corner else np.zeros(x.shape, bool)
    thing = (np.abs(x - 3.0) < 0.75) & (y > 1.7) & (y < 2.95) & ~unseen if corner else unseen
    return Layer(~unseen & ~thing & (x < end_m), thing, np.array([0.0, -3.0]), 0.1)


def goals(task, layer, x, y, now_s=0.0):
    return layer.centres(task.goals(layer, beside(x, y, now_s))).reshape(-1, 2)


def test_exploration_visits_frontiers_walls_and_openings():
    door = Candidate(np.array([0.5, 0.0]), np.array([-1.0, 0.0]), np.array([[2.0, 1.5]]))
    task = Explore()
    task.consider([door])
    found = goals(task, plain(5.0), 4.5, 0.0)
    assert found[:, 0].max() > 4.5, "the border of what was never seen"
    assert found[:, 0].min() < 2.6, "and the door"
    assert goals(task, plain(5.0), 2.2, 0.0, 0.5)[:, 0].max() < 2.6, "the door alone where it is on the way"


def test_exploration_covers_every_wall_and_ends():
    """A drone that is at its goal at once; of the border of the unseen it sees no more."""
    task, layer, x, y, yaw = Explore(), plain(5.0), 2.0, 0.0, 0.0
    for now_s in np.arange(0.0, 400.0, 0.1):
        state = DroneState(now_s, np.array([x, y, 1.15]), yaw, np.zeros(3))
        if task.result(state):
            break
        if (heading := task.look_rad(state)) is not None:
            yaw += float(np.clip(math.remainder(heading - yaw, 2.0 * math.pi), -0.1, 0.1))
        elif len(found := goals(task, layer, x, y, now_s)):
            x, y = found[np.argmin(np.hypot(*(found - [x, y]).T))]
    assert now_s < 399.0
    task._views.goals(layer, beside(x, y), NO_FRONTIER)
    assert len(task._views._left.p_w) * 0.1 < 2.0, "of 22 m of wall"


def test_exploring_leaves_narrow_borders_for_later():
    """What is unseen in a thing near by, the open end of the room, and a door to look at."""
    door = Candidate(np.array([0.5, -1.0]), np.array([-1.0, 0.0]), np.array([[2.0, 0.5]]))
    task = Explore()
    task._views._coverage = Covered()
    task.consider([door])
    corner = [3.0, 1.5]
    near = [np.linalg.norm(goals(task, plain(end, True), 4.0, 0.5) - corner, axis=1).min() for end in (5.0, 9.0)]
    assert min(near) > 0.5
    task.consider([])
    assert goals(task, plain(9.0, True), 4.0, 0.5, 1.0)[:, 1].min() > 1.0, "then the corner"


def test_exploring_goes_on_while_there_is_an_opening_to_look_at():
    """All is known and looked at: it would end after a look around."""
    known = Layer(np.ones((60, 60), bool), np.zeros((60, 60), bool), np.array([0.0, -3.0]), 0.1)
    ends, goes_on = Explore(), Explore()
    ends._views._coverage = goes_on._views._coverage = Covered()
    for now_s in np.arange(0.0, 20.0, 0.5):
        if now_s == 5.0:
            goes_on.consider([DOOR])
        ends.goals(known, beside(0.5, 1.0, now_s))
        assert len(goes_on.goals(known, beside(0.5, 1.0, now_s))) == 0 or now_s >= 5.0
    assert ends.result(beside(0.5, 1.0, 20.0))
    assert not goes_on.result(beside(0.5, 1.0, 20.0))
