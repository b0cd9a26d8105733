"""Second looks at candidate openings."""

import math

import numpy as np
import pytest
from views import longer

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.second_look import SecondLook
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapViews
from edgeslam_torch.navigation.openings.exit_tracker import Candidate
from edgeslam_torch.navigation.tasks import Explore

DOOR = Candidate(np.array([3.0, 0.0]), np.array([1.0, 0.0]), np.array([1.5, 1.0]))
"""In a wall across x, seen from its left half."""


VIEWS = MapViews()


def at(x, y, now_s=0.0):
    return DroneState(now_s, np.array([x, y, 1.15]), 0.0, np.zeros(3), views=VIEWS)


def room(solid=None):
    """Six metres by six around the door; its wall at x of 3."""
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    is_solid = (np.abs(x - 3.0) < 0.1) & (np.abs(y) > 0.45)
    is_solid |= solid(x, y) if solid else False
    return Layer(~is_solid, is_solid, np.array([0.0, -3.0]), 0.1)


def wanted(look, layer, here=(0.5, 1.0), now_s=0.0):
    return layer.centres(look.goals(layer, at(*here, now_s))).reshape(-1, 2)


def test_goals_on_the_way_are_near():
    look = considering(DOOR)
    near = room().centres(look.on_the_way(room(), at(1.2, -0.5)))
    assert len(near)
    assert np.linalg.norm(near - [1.2, -0.5], axis=1).max() <= 1.2
    assert len(look.on_the_way(room(), at(0.5, 2.5))) == 0


def considering(*candidates):
    look = SecondLook()
    look.consider(candidates)
    return look


@pytest.mark.parametrize("turned", [1.0, -1.0], ids=["normal away", "normal towards"])
def test_viewpoints_are_in_front_and_away_from_the_first(turned):
    places = wanted(considering(Candidate(DOOR.centre_w, turned * DOOR.normal_w, DOOR.place_w)), room())
    assert len(places)
    look = considering(DOOR)
    for place in places:
        for angle in np.arange(0.0, 6.3, 0.4):
            near = place + 0.13 * np.array([math.cos(angle), math.sin(angle)])
            assert look.heading_rad(at(*near)) is not None, "a pilot comes within fifteen centimetres"
    before = 3.0 - places[:, 0]
    assert before.min() >= 0.8
    assert before.max() <= 2.0, "on the side that it was seen from, and not from afar"
    assert (np.abs(places[:, 1]) <= 0.3 * before).all(), "not along the wall"
    assert np.linalg.norm(places - DOOR.place_w, axis=1).min() >= 0.6


def test_unreachable_viewpoints_are_excluded():
    fence = room(lambda x, y: np.abs(x - 0.8) < 0.1)
    assert len(wanted(considering(DOOR), fence)) == 0
    table = room(lambda x, y: (np.abs(x - 1.3) < 0.1) & (np.abs(y) < 0.1))
    assert np.abs(wanted(considering(DOOR), table) - [1.3, 0.0]).max(1).min() > 0.3


def test_it_stands_and_looks_at_the_opening_for_seconds():
    look = considering(DOOR)
    assert look.heading_rad(at(1.5, 1.0)) is None, "from where it was seen"
    assert look.heading_rad(at(1.8, -0.3, 1.0)) == pytest.approx(math.atan2(0.3, 1.2))
    assert look.heading_rad(at(1.8, -0.3, 4.9)) is not None
    assert look.heading_rad(at(1.8, -0.3, 5.1)) is None
    assert len(wanted(look, room(), now_s=5.2)) == 0, "nor is it flown to once more"


def test_unreached_viewpoint_is_given_up():
    look = considering(DOOR)
    assert len(wanted(look, room(), now_s=10.0))
    assert len(wanted(look, room(), now_s=39.0))
    assert len(wanted(look, room(), now_s=41.0)) == 0
    other = Candidate(np.array([3.0, -2.0]), DOOR.normal_w, np.array([1.5, -2.5]))
    look.consider([DOOR, other])
    assert len(wanted(look, room(), now_s=42.0)), "another one is not"


def test_looks_follow_map_corrections():
    """Metres become twice as long: what was given up at 3 m is at 6."""
    look = considering(DOOR)
    look.heading_rad(at(1.8, -0.3, 0.0))
    VIEWS.correct(longer(2.0))
    look.consider(())
    assert look.heading_rad(at(1.8, -0.3, 5.0)) is None, "what it was told lay where the map was"
    look.consider([Candidate(np.array([6.0, 0.0]), DOOR.normal_w, np.array([3.0, 2.0]))])
    assert look.heading_rad(at(5.0, 0.0, 5.0)) is None
    look.consider([DOOR])
    assert look.heading_rad(at(1.8, -0.3, 5.0)) is not None


def test_hypothesis_may_be_viewed_from_its_first_viewpoint():
    """In a corridor of two metres there is no other place before a door."""
    before = np.array([1.8, 0.0])
    assert considering(Candidate(DOOR.centre_w, DOOR.normal_w, before)).heading_rad(at(*before)) is None
    hypotheses = considering(Candidate(DOOR.centre_w, DOOR.normal_w, before, elsewhere=False))
    assert hypotheses.heading_rad(at(*before)) == pytest.approx(0.0)
    assert np.linalg.norm(wanted(hypotheses, room()) - before, axis=1).min() < 0.1


def test_unconfirmed_candidate_gets_two_more_looks():
    look, stood = considering(DOOR), []
    for k in range(4):
        look.once_more(at(0.0, 0.0, 10.0 * k))
        places = wanted(look, room(), now_s=10.0 * k)
        if k == 3:
            assert len(places) == 0, "three times in all"
            break
        assert all(np.linalg.norm(places - place, axis=1).min() > 0.3 for place in stood)
        stood.append(places[0])
        assert look.heading_rad(at(*places[0], 10.0 * k)) is not None
        look.once_more(at(0.0, 0.0, 10.0 * k + 3.9))
        assert look.heading_rad(at(*places[0], 10.0 * k + 4.1)) is None
    assert len(stood) == 3


def test_unreached_candidate_is_not_retried():
    look = considering(DOOR)
    assert len(wanted(look, room(), now_s=0.0))
    look.once_more(at(0.0, 0.0, 31.0))
    assert len(wanted(look, room(), now_s=31.0)) == 0


def plain(end_m=9.0, corner=False):
    """A room of six metres by six; what is beyond ``end_m`` was not seen, nor is a corner behind something."""
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    unseen = (np.abs(x - 3.0) < 0.5) & (np.abs(y - 2.2) < 0.5) if corner else np.zeros(x.shape, bool)
    thing = (np.abs(x - 3.0) < 0.75) & (y > 1.7) & (y < 2.95) & ~unseen if corner else unseen
    return Layer(~unseen & ~thing & (x < end_m), thing, np.array([0.0, -3.0]), 0.1)


def goals(task, layer, x, y, now_s=0.0):
    return layer.centres(task.goals(layer, at(x, y, now_s))).reshape(-1, 2)


def test_exploration_visits_frontiers_walls_and_candidates():
    door = Candidate(np.array([0.5, 0.0]), np.array([-1.0, 0.0]), np.array([2.0, 1.5]))
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
        if task.done(state):
            break
        if (heading := task.heading_rad(state)) is not None:
            yaw += float(np.clip(math.remainder(heading - yaw, 2.0 * math.pi), -0.1, 0.1))
        elif len(found := goals(task, layer, x, y, now_s)):
            x, y = found[np.argmin(np.hypot(*(found - [x, y]).T))]
    assert now_s < 399.0
    task._around.goals(layer, at(x, y))
    assert len(task._around._left.p_w) * 0.1 < 2.0, "of 22 m of wall"


def test_exploring_leaves_narrow_borders_for_later():
    """What is unseen in a thing near by, the open end of the room, and a door to look at."""
    door = Candidate(np.array([0.5, -1.0]), np.array([-1.0, 0.0]), np.array([2.0, 0.5]))
    task = Explore()
    task._around = Nothing()
    task.consider([door])
    corner = [3.0, 1.5]
    near = [np.linalg.norm(goals(task, plain(end, True), 4.0, 0.5) - corner, axis=1).min() for end in (5.0, 9.0)]
    assert min(near) > 0.5
    task.consider([])
    assert goals(task, plain(9.0, True), 4.0, 0.5, 1.0)[:, 1].min() > 1.0, "then the corner"


class Nothing:
    """Looks around that have nothing to look at."""

    def goals(self, layer, state):
        return np.zeros((0, 2), int)


def test_exploration_revisits_candidates_last():
    task = Explore()
    task._around = Nothing()
    task.consider([DOOR])
    assert len(goals(task, plain(), 0.5, 1.0))
    task._second.heading_rad(at(1.8, -0.3, 1.0))
    again = goals(task, plain(), 1.8, -0.3, 6.0)
    assert len(again) and np.linalg.norm(again - [1.8, -0.3], axis=1).min() > 0.3


def test_exploring_goes_on_while_there_is_an_opening_to_look_at():
    """All is known and looked at: it would end after a look around."""
    known = Layer(np.ones((60, 60), bool), np.zeros((60, 60), bool), np.array([0.0, -3.0]), 0.1)
    ends, goes_on = Explore(), Explore()
    ends._around = goes_on._around = Nothing()
    for now_s in np.arange(0.0, 20.0, 0.5):
        if now_s == 5.0:
            goes_on.consider([DOOR])
        ends.goals(known, at(0.5, 1.0, now_s))
        assert len(goes_on.goals(known, at(0.5, 1.0, now_s))) == 0 or now_s >= 5.0
    assert ends.done(at(0.5, 1.0, 20.0))
    assert not goes_on.done(at(0.5, 1.0, 20.0))
