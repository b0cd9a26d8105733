"""A second look at what looked like an opening from one place."""

import math

import numpy as np
import pytest

from edgeslam_torch.navigation.exploring.second_look import SecondLook
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.moved import Moved
from edgeslam_torch.navigation.openings.watch import Candidate
from edgeslam_torch.navigation.sight import Sight
from edgeslam_torch.navigation.tasks import Explore

DOOR = Candidate(np.array([3.0, 0.0]), np.array([1.0, 0.0]), np.array([1.5, 1.0]))
"""In a wall across x, seen from its left half."""


def at(x, y, now_s=0.0):
    return Sight(now_s, np.array([x, y, 1.15]), 0.0, np.zeros(3))


def room(solid=None):
    """Six metres by six around the door; its wall at x of 3."""
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    is_solid = (np.abs(x - 3.0) < 0.1) & (np.abs(y) > 0.45)
    is_solid |= solid(x, y) if solid else False
    return Layer(~is_solid, is_solid, np.array([0.0, -3.0]), 0.1)


def wanted(look, layer, here=(0.5, 1.0), now_s=0.0):
    return layer.centres(look.goals(layer, at(*here, now_s))).reshape(-1, 2)


def test_what_is_on_the_way_is_near():
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
def test_it_looks_from_before_the_opening_and_elsewhere(turned):
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


def test_no_place_that_nothing_leads_to():
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


def test_a_place_that_it_does_not_come_to_is_given_up():
    look = considering(DOOR)
    assert len(wanted(look, room(), now_s=10.0))
    assert len(wanted(look, room(), now_s=39.0))
    assert len(wanted(look, room(), now_s=41.0)) == 0
    other = Candidate(np.array([3.0, -2.0]), DOOR.normal_w, np.array([1.5, -2.5]))
    look.consider([DOOR, other])
    assert len(wanted(look, room(), now_s=42.0)), "another one is not"


def test_what_was_tried_goes_along_with_the_map():
    """Metres become twice as long: what was given up at 3 m is at 6."""
    look = considering(DOOR)
    look.heading_rad(at(1.8, -0.3, 0.0))
    look.carry(Moved(np.eye(4)[None], np.eye(4)[None], 2.0))
    assert look.heading_rad(at(1.8, -0.3, 5.0)) is None, "what it was told lay where the map was"
    look.consider([Candidate(np.array([6.0, 0.0]), DOOR.normal_w, np.array([3.0, 2.0]))])
    assert look.heading_rad(at(5.0, 0.0, 5.0)) is None
    look.consider([DOOR])
    assert look.heading_rad(at(1.8, -0.3, 5.0)) is not None


def test_exploring_flies_back_for_a_doubt_when_nothing_is_left_to_see():
    """A border of the unseen at the right; a door to look at a good way behind the drone, or beside it."""
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    ends = Layer(np.broadcast_to(x < 5.0, y.shape), np.zeros((60, 60), bool), np.array([0.0, -3.0]), 0.1)
    known = Layer(np.ones((60, 60), bool), np.zeros((60, 60), bool), np.array([0.0, -3.0]), 0.1)
    door = Candidate(np.array([0.5, 0.0]), np.array([-1.0, 0.0]), np.array([2.0, 1.5]))
    task = Explore()
    task.consider([door])
    assert ends.centres(task.goals(ends, at(4.5, 0.0)))[:, 0].min() > 4.5, "there is a border ahead"
    assert ends.centres(task.goals(ends, at(2.2, 0.0, 0.5)))[:, 0].max() < 2.6, "it is on the way"
    assert known.centres(task.goals(known, at(4.5, 0.0, 1.0)))[:, 0].max() < 2.6, "nothing is left to see"


def test_exploring_leaves_narrow_borders_for_later():
    """What is unseen in a thing near by, the open end of the room, and a door to look at."""
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    corner = (np.abs(x - 3.0) < 0.5) & (np.abs(y - 2.2) < 0.5)
    thing = (np.abs(x - 3.0) < 0.75) & (y > 1.7) & (y < 2.95) & ~corner
    low = np.array([0.0, -3.0])
    both, narrow = (Layer(~corner & ~thing & (x < end), thing, low, 0.1) for end in (5.0, 9.0))
    door = Candidate(np.array([0.5, -1.0]), np.array([-1.0, 0.0]), np.array([2.0, 0.5]))
    task = Explore()
    task.consider([door])
    assert both.centres(task.goals(both, at(4.0, 0.5)))[:, 0].min() > 4.5, "the open end"
    assert narrow.centres(task.goals(narrow, at(4.0, 0.5, 0.5)))[:, 1].max() < 0.0, "then the door"
    task.consider([])
    assert narrow.centres(task.goals(narrow, at(4.0, 0.5, 1.0)))[:, 1].min() > 1.0, "then the corner"


def test_exploring_looks_around_more_closely_when_nothing_else_is_left():
    known = Layer(np.ones((60, 60), bool), np.zeros((60, 60), bool), np.array([0.0, -3.0]), 0.1)
    task = Explore()
    assert len(task.goals(known, at(1.0, 0.0))) == 0
    for k, x in enumerate([1.0, 2.3]):
        task.heading_rad(at(x, 0.0, 20.0 * k))
        task.heading_rad(at(x, 0.0, 20.0 * k + 15.0))  # it does not turn, and gives that up
    goals = known.centres(task.goals(known, at(2.3, 0.0, 40.0)))
    assert goals == pytest.approx(np.array([[1.65, 0.05]]), abs=0.06)
    assert task.heading_rad(at(1.66, 0.0, 45.0)) is not None
    task.heading_rad(at(1.66, 0.0, 60.0))
    assert len(task.goals(known, at(1.66, 0.0, 61.0))) == 0
    assert not task.done(at(1.66, 0.0, 61.0)) and task.done(at(1.66, 0.0, 75.0))


@pytest.mark.parametrize(("border_x", "closely"), [(5.0, True), (3.0, False)])
def test_on_another_pass_exploring_looks_more_closely_far_from_what_is_unseen(border_x, closely):
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    ends = Layer(np.broadcast_to(x < border_x, y.shape), np.zeros((60, 60), bool), np.array([0.0, -3.0]), 0.1)
    task = Explore()
    for k, place in enumerate([1.0, 2.3]):
        task.heading_rad(at(place, 0.0, 20.0 * k))
        task.heading_rad(at(place, 0.0, 20.0 * k + 15.0))
    assert len(task.goals(ends, at(1.65, 0.0, 40.0)))
    assert (task.heading_rad(at(1.65, 0.0, 40.1)) is not None) == closely


def test_exploring_goes_on_while_there_is_an_opening_to_look_at():
    """All is known: it would end after a look around."""
    known = Layer(np.ones((60, 60), bool), np.zeros((60, 60), bool), np.array([0.0, -3.0]), 0.1)
    ends, goes_on = Explore(), Explore()
    for now_s in np.arange(0.0, 20.0, 0.5):
        if now_s == 5.0:
            goes_on.consider([DOOR])
        ends.goals(known, at(0.5, 1.0, now_s))
        assert len(goes_on.goals(known, at(0.5, 1.0, now_s))) == 0 or now_s >= 5.0
    assert ends.done(at(0.5, 1.0, 20.0))
    assert not goes_on.done(at(0.5, 1.0, 20.0))
