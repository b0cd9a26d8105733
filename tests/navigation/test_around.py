"""Looking around while exploring."""

import math

import numpy as np
import pytest
from views import longer

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.around import LooksAround, _in_turn
from edgeslam_torch.navigation.exploring.coverage import Borders
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapViews


def at(now_s, x, yaw_deg, tracked=True):
    here = np.array([x, 0.0, 1.15])
    return DroneState(now_s, here, math.radians(yaw_deg), np.zeros(3), tracked=tracked, views=VIEWS)


VIEWS = MapViews()


def corridor(long_m=6.0):
    """Two metres wide, from 1 m behind the drone to where it ends."""
    x, y = np.meshgrid((np.arange(100) + 0.5) * 0.1 - 2.0, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    free = (np.abs(y) < 0.95) & (x > -1.0) & (x < long_m)
    return Layer(free, ~free, np.array([-2.0, -3.0]), 0.1)


CORRIDOR = corridor()


def asked(looks, x, now_s=0.0, layer=CORRIDOR):
    """Places ``(G, 2)`` from which to look."""
    return layer.centres(looks.goals(layer, at(now_s, x, 0.0))).reshape(-1, 2)


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
    seen = np.array(looked(LooksAround(), 2.0))
    for side in (1.0, -1.0):
        assert (np.abs(side * seen - 90.0) < 8.0).any(), "a door beside the corridor comes to the picture's middle"
    assert len(seen) < 20 * 10, "in less than ten seconds"


def test_covered_borders_are_not_viewed_again():
    looks = LooksAround()
    assert looked(looks, 2.0)
    looks.goals(CORRIDOR, at(30.0, 2.0, 0.0))
    left = looks._left.p_w
    beside = (np.abs(left[:, 0] - 2.0) < 0.9) & (np.abs(left[:, 1]) < 1.1)
    assert beside.sum() * 0.1 < 0.4, "of four metres of wall"
    assert not looked(looks, 2.1, begin_s=40.0), "and there it does not stand again"


def test_viewpoints_cover_all_borders_greedily():
    looks, x, stands = LooksAround(), 0.0, 0
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
    looks = LooksAround()
    assert looks.heading_rad(at(0.0, 2.0, 0.0)) is None, "nothing is known yet"
    x, y = np.meshgrid((np.arange(60) + 0.5) * 0.1, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    small = Layer(np.hypot(x - 2.0, y) < 0.5, np.zeros(x.shape, bool), np.array([0.0, -3.0]), 0.1)
    looks.goals(small, at(0.1, 2.0, 0.0))
    assert looks.heading_rad(at(0.2, 2.0, 0.0)) is None, "all is nearer than a door fits into a picture"


def test_viewpoint_without_success_is_not_repeated():
    looks = LooksAround()
    best = asked(looks, 2.0)[0]
    looked(looks, float(best[0]), turns=False)
    places = asked(looks, float(best[0]), 30.0)
    assert len(places) and np.linalg.norm(places - [best[0], 0.0], axis=1).min() > 0.4


@pytest.mark.parametrize(("cells", "stands"), [(4, False), (8, True)])
def test_less_than_a_doors_width_of_wall_is_no_reason_to_stand(cells, stands):
    looks = LooksAround()
    looks._left = Borders(np.array([[2.0 + 0.1 * k, 1.0] for k in range(cells)]), np.tile([0.0, -1.0], (cells, 1)), 0.1)
    assert (looks.heading_rad(at(0.0, 2.2, 0.0)) is not None) == stands


def test_a_lost_pose_and_a_drone_that_does_not_turn_end_it():
    looks = LooksAround()
    asked(looks, 2.0)
    assert looks.heading_rad(at(0.0, 2.0, 0.0)) is not None
    assert looks.heading_rad(at(0.1, 2.0, 0.0, tracked=False)) is None
    assert looks.heading_rad(at(0.2, 2.0, 0.0)) is None
    assert len(looked(LooksAround(), 2.0, seconds=20.0, turns=False)) == pytest.approx(320, abs=2)


def test_positions_follow_map_corrections():
    """Metres become twice as long: where it has looked around, 2 m from its take-off, is 4 m from it."""
    looks = LooksAround()
    assert looked(looks, 2.0)
    VIEWS.correct(longer(2.0))
    assert not looked(looks, 4.1, begin_s=30.0)
    assert looked(looks, 2.0, begin_s=60.0)


def test_headings_follow_each_other_the_short_way_round():
    assert _in_turn([math.radians(a) for a in (-100.0, 160.0, 60.0)]) == pytest.approx(
        [math.radians(a) for a in (60.0, 160.0, -100.0)]
    )
    assert _in_turn([]) == []
