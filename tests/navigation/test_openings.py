"""Exits and pathways against walls whose openings are known, at every angle to the grid."""

import math
from dataclasses import replace

import numpy as np
import pytest
from views import longer, moved

from edgeslam_torch.navigation.drone_state import DroneState, View
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapUpdate, MapViews
from edgeslam_torch.navigation.openings.exit_tracker import ExitTracker
from edgeslam_torch.navigation.openings.exits import has_detour, openings
from edgeslam_torch.navigation.openings.pathways import pathways
from edgeslam_torch.navigation.openings.wall_frame import Walls, along_walls, wall_directions
from edgeslam_torch.navigation.pilot import Pilot
from edgeslam_torch.navigation.skills.explore import Explore
from edgeslam_torch.navigation.skills.go_to import GoTo
from edgeslam_torch.navigation.space import Space

ANGLES = [0.0, 0.3, math.pi / 4, 1.9]
HERE = np.zeros(2)


def gaps(walls):
    """Openings all of which is known to be free."""
    return [gap for gap in openings(along_walls(walls, HERE)) if gap.is_free]


def surroundings(is_solid, is_unseen=lambda x, y: np.zeros(x.shape, bool), angle=0.0, low=None):
    """A square of 12 m around the origin; what is where is said in axes turned by ``angle``."""
    x, y = np.meshgrid((np.arange(120) + 0.5) * 0.1 - 6.0, (np.arange(120) + 0.5) * 0.1 - 6.0, indexing="ij")
    c, s = math.cos(angle), math.sin(angle)
    a, b = c * x + s * y, c * y - s * x
    solid, unseen = is_solid(a, b), is_unseen(a, b)
    layer = Layer(~solid & ~unseen, solid & ~unseen, np.array([-6.0, -6.0]), 0.1)
    return Walls(layer, layer.solid if low is None else layer.solid & ~low(a, b))


def turned_back(p, angle):
    """A point of the world in the axes in which the surroundings are said."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * p[0] + s * p[1], c * p[1] - s * p[0]])


def wall(gap, at=2.0, middle=0.0):
    """A wall across the first axis, from -3 to 3, with an opening of this width; what it touches is solid."""
    return lambda a, b: (np.abs(a - at) < 0.1) & (np.abs(b) < 3.0) & (np.abs(b - middle) > 0.5 * gap - 0.05)


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize(("gap", "middle"), [(0.7, 0.0), (0.9, -0.8), (1.2, 0.6)])
def test_a_doorway_is_where_it_is(angle, gap, middle):
    (found,) = gaps(surroundings(wall(gap, middle=middle), angle=angle))
    assert turned_back(found.centre_w, angle) == pytest.approx([2.0, middle], abs=0.12)
    assert turned_back(found.normal_w, angle) == pytest.approx([1.0, 0.0], abs=0.1), "away from where it is seen"
    assert found.width_m == pytest.approx(gap, abs=0.16)


def cupboards(a, b):
    """A corridor of 2 m, and a cupboard of 0.5 m by 0.8 m at each side of it."""
    return (np.abs(b) > 1.0) & (np.abs(b) < 1.2) | (np.abs(a - 2.0) < 0.4) & (np.abs(b) > 0.5) & (np.abs(b) < 1.2)


def bulging(a, b):
    """A corridor of 1.4 m whose walls, as a network sees them, come 10 cm nearer on half a metre, and are as thick."""
    half = np.where(np.abs(a - 2.0) < 0.25, 0.6, 0.7)
    return (np.abs(b) > half) & (np.abs(b) < 1.2)


@pytest.mark.parametrize(
    ("case", "solid", "unseen", "low"),
    [
        ("a wall, a poster or a closed door", wall(0.0), None, None),
        ("too narrow", wall(0.4), None, None),
        ("a wall that ends", wall(2.4), None, None),
        ("nothing was seen behind it", wall(0.9), lambda a, b: a > 2.15, None),
        ("a niche", lambda a, b: wall(0.9)(a, b) | ((a > 2.4) & (a < 2.7) & (np.abs(b) < 3.0)), None, None),
        ("tables", wall(0.9), None, lambda a, b: a > 0.0),
        ("cupboards along a corridor", cupboards, None, None),
        ("a corridor that bulges", bulging, None, None),
        ("thick walls of a corridor, across it", lambda a, b: (np.abs(b) > 0.6) & (np.abs(b) < 1.1), None, None),
        ("a post before a wall", lambda a, b: (b > 1.0) & (b < 1.2) | (np.hypot(a - 2, b) < 0.2), None, None),
    ],
)
@pytest.mark.parametrize("angle", [0.0, 0.5])
def test_false_openings_are_no_exits(case, solid, unseen, low, angle):
    seen = surroundings(solid, unseen or (lambda a, b: np.zeros(a.shape, bool)), angle, low)
    assert gaps(seen) == [], case


def smeared(angle=0.0, is_unseen=lambda a, b: np.zeros(a.shape, bool)):
    """A door that is open, and what was seen of its frame from aside: it closes a third of it, at some heights."""
    frame = lambda a, b: (np.abs(a - 2.0) < 0.1) & (b > 0.15) & (b < 0.45)  # noqa: E731
    return surroundings(lambda a, b: wall(0.9)(a, b) | frame(a, b), is_unseen, angle, frame)


@pytest.mark.parametrize("angle", ANGLES)
def test_a_door_into_which_its_frame_smears_may_be_one(angle):
    (found,) = [gap for gap in openings(along_walls(smeared(angle), HERE)) if gap.leads]
    assert not found.is_free and gaps(smeared(angle)) == []
    assert turned_back(found.centre_w, angle) == pytest.approx([2.0, 0.0], abs=0.12)
    assert found.width_m == pytest.approx(0.9, abs=0.16)


@pytest.mark.parametrize(
    ("case", "walls"),
    [
        ("a closed door before a room", surroundings(wall(0.0))),
        (
            "a door of which nothing is known to be free",
            surroundings(wall(0.9), lambda a, b: (np.abs(a - 2.0) < 0.2) & (np.abs(b) < 0.45)),
        ),
        ("nothing was seen behind it", smeared(is_unseen=lambda a, b: a > 2.15)),
    ],
)
def test_impossible_doors_are_rejected(case, walls):
    assert not any(gap.leads for gap in openings(along_walls(walls, HERE))), case


def state(x, y=0.0, stamp_s=0.0, yaw=0.0, **fields):
    return DroneState(stamp_s, np.array([x, y, 1.15]), yaw, np.zeros(3), **fields)


def watched(places, walls, views=None):
    watch = ExitTracker()
    for k, x in enumerate(places):
        watch.look(walls, state(x, stamp_s=0.5 * k, views=views or MapViews()))
    return watch


def test_an_exit_is_seen_from_two_places():
    walls = surroundings(wall(0.9))
    assert watched([0.0] * 8, walls).exits == ()
    (exit_,) = watched([0.0, 0.1, 0.2, 0.6], walls).exits
    assert exit_.centre_w == pytest.approx([2.0, 0.0, 1.15], abs=0.12)
    assert exit_.normal_w == pytest.approx([1.0, 0.0, 0.0], abs=0.05)
    assert exit_.width_m == pytest.approx(0.9, abs=2.0 * exit_.width_sigma_m + 0.05)
    assert exit_.places == 2
    assert exit_.beyond(1.0)[0] == pytest.approx(3.0, abs=0.12)


def test_one_viewpoint_makes_a_candidate_two_an_exit():
    walls = surroundings(wall(0.9))
    assert watched([0.0], walls).candidates == (), "one look is chance"
    (candidate,) = watched([0.0] * 8, walls).candidates
    assert candidate.centre_w == pytest.approx([2.0, 0.0], abs=0.12)
    assert abs(candidate.normal_w[0]) == pytest.approx(1.0, abs=0.05)
    assert candidate.saturated_w == pytest.approx(np.zeros((1, 2)))
    assert watched([0.0, 0.1, 0.2, 0.6], walls).candidates == ()
    assert watched([0.0] * 8, surroundings(PILLARS)).candidates == (), "what can be passed by"


def test_its_normal_keeps_its_side_when_the_drone_has_flown_through():
    (exit_,) = watched([0.0, 0.6, 1.2, 2.8, 3.4], surroundings(wall(0.9))).exits
    assert exit_.normal_w[0] == pytest.approx(1.0, abs=0.05)


def test_its_sigma_has_that_of_the_metres():
    walls, watch = surroundings(wall(0.9)), ExitTracker()
    for k, x in enumerate([0.0, 0.2, 0.4, 0.6]):
        watch.look(walls, state(x, stamp_s=0.5 * k, scale_sigma=0.2))
    (exit_,) = watch.exits
    assert exit_.position_sigma_m == pytest.approx(0.2 * 1.4, rel=0.25)
    assert exit_.width_sigma_m > 0.17


def test_an_opening_that_closes_under_closer_looks_is_forgotten():
    watch = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)))
    for k in range(12):
        watch.look(surroundings(wall(0.0)), state(0.6, stamp_s=5.0 + 0.5 * k))
    assert watch.exits == ()


def test_exit_is_withdrawn_after_consecutive_misses():
    """From afar, depth shows a poster six metres deep."""
    door, closed = surroundings(wall(0.9)), surroundings(wall(0.0))
    watch = watched([0.0, 0.2, 0.4, 0.6] * 10, door)
    for k in range(4):
        watch.look(closed, state(0.6, stamp_s=30.0 + 0.5 * k))
    assert len(watch.exits) == 1, "twenty seconds against two"
    watch.look(closed, state(0.6, stamp_s=33.0))
    assert watch.exits == ()
    assert len(watch.candidates) == 1
    for k in range(9):
        watch.look(closed, state(0.6, stamp_s=33.5 + 0.5 * k))
    assert watch.candidates == (), "nor is it worth a second look"
    watch.look(door, state(0.6, stamp_s=40.0))
    assert watch.exits == (), "nor does a single look outweigh these"
    for k in range(4):
        watch.look(door, state(0.6, stamp_s=40.5 + 0.5 * k))
    assert len(watch.exits) == 1


def test_an_exit_was_seen_by_looks_at_it():
    """A corridor narrowed by noise, seen repeatedly from a growing distance."""
    door, closed = surroundings(wall(0.9)), surroundings(wall(0.0))
    watch = ExitTracker()
    for k, x in enumerate([1.0, 0.4, 0.0, -0.4] * 5):
        watch.look(door, state(x, stamp_s=0.5 * k, yaw=math.pi))
    assert watch.exits == (), "nothing speaks for it"
    assert len(watch.candidates) == 1, "to be looked at"
    for k in range(4):
        watch.look(door, state(0.0, stamp_s=15.0 + 0.5 * k))
        assert watch.exits == (), "one viewpoint is chance"
    watch.look(door, state(-0.4, stamp_s=17.5))
    for k in range(4):
        assert len(watch.exits) == 1, "one look or two more against it are chance"
        watch.look(closed, state(0.0, stamp_s=20.0 + 0.5 * k))
    assert watch.exits == ()
    assert len(watch.candidates) == 1
    for k in range(5):
        watch.look(door, state(0.0, stamp_s=23.0 + 0.5 * k))
    assert len(watch.exits) == 1
    assert watch.candidates == (), "looked at"


def flown(ys, closed=False):
    """A watch that saw a door, was flown along a line through the wall, and sees the wall closed afterwards."""
    watch = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)))
    for k, x in enumerate(np.arange(1.2, 3.2, 0.2)):
        watch.look(surroundings(wall(0.9)), state(x, ys, 3.0 + 0.5 * k))
    for k in range(12):
        watch.look(surroundings(wall(0.0)), state(3.4, ys, 9.0 + 0.5 * k, math.atan2(-ys, -1.4)))
    return watch


def test_what_it_flew_through_is_an_exit_whatever_looks_show_later():
    """Walls half a metre thick on the map: both rooms see them with an offset of 0.2 m."""
    assert len(flown(0.0).exits) == 1
    assert flown(0.0).candidates == ()
    assert flown(0.8).exits == (), "beside it"


def test_no_door_was_flown_through_where_the_map_shows_no_wall_any_more():
    """From afar two obstacles looked like its jambs."""
    watch, open_ = watched([0.0], surroundings(wall(0.9))), surroundings(lambda a, b: np.abs(b) > 2.5)
    for k, x in enumerate(np.arange(1.2, 3.2, 0.2)):
        watch.look(open_, state(x, stamp_s=3.0 + 0.5 * k))
    assert watch.exits == () and all(math.isfinite(track.odds) for track in watch._tracks)


def test_a_jump_of_the_pose_is_no_way_through():
    watch = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)))
    for k, x in enumerate([1.2, 3.0]):
        watch.look(surroundings(wall(0.9)), state(x, 0.0, 3.0 + 0.5 * k))
    assert all(math.isfinite(track.odds) for track in watch._tracks)
    watch.look(surroundings(wall(0.9)), state(2.6, 0.0, 4.5))
    watch.expire()
    watch.look(surroundings(wall(0.9)), state(1.8, 0.0, 5.0))
    assert all(math.isfinite(track.odds) for track in watch._tracks), "nor is a map that moved"


@pytest.mark.parametrize(
    ("case", "x", "y", "yaw_deg"),
    [("along the wall", 1.4, -1.6, 68.0), ("from afar", -0.7, 0.0, 0.0), ("elsewhere", 0.6, 0.0, 30.0)],
)
def test_views_that_do_not_cover_an_exit_do_not_lower_its_odds(case, x, y, yaw_deg):
    """A door beside the corridor, seen at a grazing angle while passing it."""
    watch = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)))
    for k in range(20):
        watch.look(surroundings(wall(0.0)), state(x, y, 5.0 + 0.5 * k, math.radians(yaw_deg)))
    assert len(watch.exits) == 1, case


def test_views_of_a_partly_open_door_do_not_lower_its_odds():
    watch = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)))
    for k in range(20):
        watch.look(smeared(), state(0.6, stamp_s=5.0 + 0.5 * k))
    assert len(watch.exits) == 1


def test_what_is_open_in_part_is_a_candidate_after_two_looks():
    walls = smeared()
    assert watched([0.0], walls).candidates == ()
    watch = watched([0.0, 0.2, 0.4, 0.6, 0.8], walls)
    assert watch.exits == ()
    assert [c.centre_w for c in watch.candidates] == [pytest.approx([2.0, 0.0], abs=0.3)]


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize(
    ("solid", "unseen", "detour"),
    [
        (wall(0.9), None, False),
        (lambda a, b: wall(0.9)(a, b) & (np.abs(b) < 1.2), None, True),  # two pillars in a room
        (lambda a, b: wall(0.9)(a, b) & (b < 1.2), None, True),  # a pillar before the end of a wall
        (lambda a, b: wall(0.9)(a, b) & (np.abs(b) < 1.2), lambda a, b: np.abs(b) > 1.25, False),  # not seen around
        (wall(0.9), lambda a, b: a > 2.15, False),
    ],
)
def test_what_can_be_passed_by_parts_nothing(solid, unseen, detour, angle):
    walls = surroundings(solid, unseen or (lambda a, b: np.zeros(a.shape, bool)), angle=angle)
    normal = np.array([math.cos(angle), math.sin(angle)])
    assert has_detour(walls.layer, 2.0 * normal, normal, 0.9) == detour


def test_pillars_are_no_exit_once_their_surroundings_are_seen():
    """Seen from two places as a wall with a door, and then it turns out that the wall ends beside it."""
    watch = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)))
    assert len(watch.exits) == 1
    for k in range(5):
        watch.look(surroundings(PILLARS), state(0.6, stamp_s=5.0 + 0.5 * k))
    assert not watch.exits


def test_ten_seconds_with_a_detour_outweigh_views_without_one():
    """A gap beside a cupboard, seen from behind it only."""
    door, pillars = surroundings(wall(0.9)), surroundings(PILLARS)
    watch = watched([0.0, 0.2, 0.4, 0.6] * 20, door)
    for k in range(19):
        watch.look(pillars, state(0.6, stamp_s=50.0 + 0.5 * k))
    assert len(watch.exits) == 1
    watch.look(pillars, state(0.6, stamp_s=60.0))
    assert watch.exits == ()
    for k in range(10):
        watch.look(pillars, state(0.6, stamp_s=61.0 + 0.5 * k))
    for k in range(10):
        watch.look(door, state(0.6, stamp_s=66.0 + 0.5 * k))
        assert watch.exits == (), "a moment later a speck closes the way round"
    watch.look(door, state(0.6, stamp_s=71.0))
    assert len(watch.exits) == 1


def test_a_way_round_that_comes_and_goes_takes_back_no_door():
    door, pillars = surroundings(wall(0.9)), surroundings(PILLARS)
    watch = watched([0.0, 0.2, 0.4, 0.6] * 3, door)
    for k in range(60):
        watch.look(pillars if k % 2 else door, state(0.6, stamp_s=10.0 + 0.5 * k))
    assert len(watch.exits) == 1


PILLARS = lambda a, b: wall(0.9)(a, b) & (np.abs(b) < 1.2)  # noqa: E731


def test_exit_survives_a_hole_beside_it_and_views_from_afar():
    """Depth errors open a hole in the wall: for a moment close by, or for long from afar."""
    watch = watched([0.0, 0.2, 0.4, 0.6, 0.6, 0.6, 0.6], surroundings(wall(0.9)))
    for k in range(3):
        watch.look(surroundings(PILLARS), state(0.6, stamp_s=5.0 + 0.5 * k))
        assert len(watch.exits) == 1
    for k in range(40):
        watch.look(surroundings(PILLARS), state(-2.2, stamp_s=6.0 + 0.5 * k))
    assert len(watch.exits) == 1


@pytest.mark.parametrize(("apart", "count"), [(0.8, 1), (1.4, 2)])
def test_a_passage_has_one_door(apart, count):
    """A door, and two objects in front of it with the same gap."""
    both = surroundings(lambda a, b: wall(0.9)(a, b) | wall(0.9, at=2.0 - apart)(a, b))
    watch = watched([-1.0, -0.8, -0.6, -0.4, -0.2], both)
    assert len(watch.exits) == count


VIEW = View(0.0, np.ones((3, 4)), np.full((3, 4), 0.1), np.eye(3), np.eye(4))


def test_no_look_without_a_view_or_metres():
    assert ExitTracker().due(state(0.0, view=VIEW))
    assert not ExitTracker().due(state(0.0)), "what the grid shows is no older than the last one"
    assert not ExitTracker().due(state(0.0, view=VIEW, metric=False))
    assert not ExitTracker().due(state(0.0, view=VIEW, tracked=False))


def test_no_look_counts_in_a_piece_of_map_that_may_lie_elsewhere():
    assert ExitTracker().due(state(0.0, view=VIEW, submap_sigma_m=0.1))
    assert not ExitTracker().due(state(0.0, view=VIEW, submap_sigma_m=0.13))


@pytest.mark.parametrize("angle", ANGLES)
@pytest.mark.parametrize("width", [1.2, 2.2])
def test_a_corridor_is_a_pathway(angle, width):
    walls = surroundings(lambda a, b: (np.abs(b - 0.3) > width / 2) & (np.abs(b - 0.3) < width / 2 + 0.2), angle=angle)
    way = pathways(walls, HERE)[0]
    assert way.width_m == pytest.approx(width, abs=0.16)
    assert abs(turned_back(way.direction_w, angle)[1]) < 0.05
    assert [turned_back(end, angle)[1] for end in way.ends_w] == pytest.approx([0.3, 0.3], abs=0.12)
    assert way.length_m > 9.0
    assert way.beside_m(way.ends_w[0]) == pytest.approx(0.0, abs=1e-9)
    assert len(pathways(walls, HERE)) == 1


def test_a_room_is_no_pathway():
    assert pathways(surroundings(lambda a, b: np.maximum(np.abs(a), np.abs(b)) > 2.5), HERE) == []


def test_without_walls_there_is_no_direction():
    assert wall_directions(surroundings(lambda a, b: np.zeros(a.shape, bool)), HERE) == []


def test_upright_is_what_fills_the_height():
    space = Space()
    for z in np.arange(0.05, 2.3, 0.1):
        space.mark(np.array([[1.05, 0.05, z]]))
        if z < 0.9:
            space.mark(np.array([[2.05, 0.05, z]]))
    upright = space.upright(0.7, 1.5, 0.7)
    layer = space.layer(1.15, 0.15)
    assert upright[tuple(layer.cells(np.array([1.05, 0.05])))]
    assert not upright[tuple(layer.cells(np.array([2.05, 0.05])))]
    with pytest.raises(ValueError, match="grid"):
        space.upright(1.0, 9.0, 0.5)


def test_an_exit_stays_where_its_pictures_stay():
    """A misplaced submap that overlaps the door must not move it when corrected."""
    walls, watch, views = surroundings(wall(0.9)), ExitTracker(), MapViews()
    for k, x in enumerate([0.0, 0.2, 0.4, 0.6]):
        views.add(10 + k, np.eye(4))
        watch.look(walls, state(x, stamp_s=0.5 * k, views=views))
    across, away = np.eye(4), np.eye(4)
    across[0, 3], away[0, 3] = 2.0, 3.0
    views.add(90, across)
    views.correct(MapUpdate(np.array([10, 90]), np.stack([np.eye(4), away])))
    unseen = surroundings(lambda a, b: np.zeros(a.shape, bool), lambda a, b: np.ones(a.shape, bool))
    watch.look(unseen, state(0.0, stamp_s=3.0, yaw=-2.0))
    assert [e.centre_w[:2] for e in watch.exits] == [pytest.approx([2.0, 0.0], abs=0.15)]


def test_exits_go_along_with_the_map():
    """Its metres become twice as long and the map turns square to the left about the origin."""
    views = MapViews()
    views.add(0, np.eye(4))
    watch = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)), views)
    after = np.array([[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    views.correct(moved(0, after, 1.3))
    unseen = surroundings(lambda a, b: np.zeros(a.shape, bool), lambda a, b: np.ones(a.shape, bool))
    watch.look(unseen, state(0.0, stamp_s=3.0, yaw=-2.0))
    (exit_,) = watch.exits
    assert exit_.centre_w[:2] == pytest.approx([0.0, 2.6], abs=0.15)
    assert exit_.normal_w[:2] == pytest.approx([0.0, 1.0], abs=0.1)
    assert exit_.width_m == pytest.approx(1.17, abs=0.2)


def test_a_revised_unit_drops_exits_without_a_view():
    pilot = Pilot(GoTo(np.array([3.0, 0.0, 1.15])))
    pilot.exits = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)))
    pilot.update(state(0.0, stamp_s=9.0))
    assert len(pilot.exits.exits) <= 1
    waits = pilot.update(replace(state(0.0, stamp_s=9.1), revision=1))
    assert pilot.exits.exits and "revised" in waits.why and not any(waits.sticks())
    pilot.update(replace(state(0.0, stamp_s=10.2), revision=1))
    assert pilot.exits.exits == ()


def test_a_revised_unit_keeps_exits_tied_to_a_view():
    pilot = Pilot(GoTo(np.array([3.0, 0.0, 1.15])))
    pilot.exits = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)), pilot.views)
    pilot.update(state(0.0, stamp_s=9.0))
    assert len(pilot.exits.exits) == 1
    pilot.update(replace(state(0.0, stamp_s=9.1, yaw=2.0), revision=1, map_update=longer(1.2)))
    pilot.update(replace(state(0.0, stamp_s=9.7, yaw=2.0, view=VIEW), revision=1))
    assert [e.centre_w[0] for e in pilot.exits.exits] == [pytest.approx(2.4, abs=0.15)]


def test_the_pilot_takes_what_is_low_for_no_wall():
    """Two rows of points at x = 1 and 2 m: the first up to 2 m, the second around the height of flight alone."""
    pilot = Pilot(GoTo(np.array([3.0, 0.0, 1.15])))
    for y in np.arange(-0.95, 1.0, 0.1):
        for z in np.arange(0.05, 2.0, 0.1):
            pilot.space.mark(np.array([[1.05, y, z]]))
        pilot.space.mark(np.array([[2.05, y, 1.15], [2.05, y, 1.05]]))
    walls = pilot.walls()
    first, second = (tuple(walls.layer.cells(np.array([x, 0.05]))) for x in (1.05, 2.05))
    assert walls.layer.solid[first] and walls.layer.solid[second]
    assert walls.upright[first] and not walls.upright[second]


def test_the_pilot_looks_at_undecided_openings(monkeypatch):
    monkeypatch.setattr(Pilot, "walls", lambda self: surroundings(wall(0.9)))
    pilot = Pilot(Explore())
    pilot.exits = watched([0.0] * 8, surroundings(wall(0.9)))
    pilot.update(state(0.0, stamp_s=9.0, view=VIEW))
    assert pilot.exits.candidates and pilot._views.openings == pilot.exits.candidates


def test_the_pilot_passes_exits_to_its_skill(monkeypatch):
    monkeypatch.setattr(Pilot, "walls", lambda self: surroundings(wall(0.9)))
    told = []

    class Listens(GoTo):
        def consider(self, exits):
            told.extend(exits)

    pilot = Pilot(Listens(np.array([3.0, 0.0, 1.15])))
    pilot.exits = watched([0.0, 0.2, 0.4, 0.6], surroundings(wall(0.9)))
    pilot.update(state(0.6, stamp_s=9.0, view=VIEW))
    assert [e.centre_w[0] for e in told] == [pytest.approx(2.0, abs=0.15)]
