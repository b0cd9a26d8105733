"""Coverage of borders by frontal views."""

import math
from dataclasses import replace

import numpy as np
import pytest
from views import longer

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.exploring.coverage import Borders, Coverage, borders
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.map_views import MapViews

WALL = Borders(np.array([[x, 1.0] for x in np.arange(-3.0, 3.05, 0.1)]), np.tile([0.0, -1.0], (61, 1)), 0.1)
"""One metre to the left of a drone that flies along x."""


def at(x, y, yaw_deg, tracked=True):
    return DroneState(0.0, np.array([x, y, 1.15]), math.radians(yaw_deg), np.zeros(3), tracked=tracked)


def corridor(free=lambda x, y: np.abs(y) < 0.95, solid=lambda x, y: np.zeros(x.shape, bool)):
    x, y = np.meshgrid((np.arange(80) + 0.5) * 0.1 - 4.0, (np.arange(60) + 0.5) * 0.1 - 3.0, indexing="ij")
    is_solid = solid(x, y)
    return Layer(free(x, y) & ~is_solid, is_solid, np.array([-4.0, -3.0]), 0.1)


def unlooked(*states):
    coverage = Coverage()
    for state in states:
        coverage.note(state)
    return coverage.unlooked(WALL)


def test_borders_within_twenty_degrees_ahead_are_covered():
    left = unlooked(at(0.0, 0.0, 90.0)).p_w[:, 0]
    reach = math.tan(math.radians(20.0))
    np.testing.assert_allclose(left, [x for x in WALL.p_w[:, 0] if abs(x) > reach], atol=1e-9)


@pytest.mark.parametrize(
    ("case", "state"),
    [
        ("along the wall", at(-2.0, 0.0, 18.0)),
        ("away from it", at(0.0, 0.0, -90.0)),
        ("from behind it", at(0.0, 2.0, -90.0)),
        ("from so near that a door does not fit", at(0.0, 0.45, 90.0)),
        ("from afar", at(0.0, -1.6, 90.0)),
        ("by telemetry", at(0.0, 0.0, 90.0, tracked=False)),
    ],
)
def test_other_views_cover_nothing(case, state):
    assert len(unlooked(state).p_w) == len(WALL.p_w), case


def test_views_accumulate_without_duplicates():
    coverage = Coverage()
    for x in (-0.6, 0.0, 0.05, 0.6):
        for yaw in (88.0, 91.0):
            coverage.note(at(x, 0.0, yaw))
    assert len(coverage._places) == 3
    assert np.abs(coverage.unlooked(WALL).p_w[:, 0]).min() > 0.9


def test_views_follow_map_corrections():
    """Metres become twice as long: what was seen 2 m away is 1 m away."""
    coverage = Coverage()
    views = MapViews()
    coverage.note(replace(at(2.0, 0.0, 90.0), views=views))
    views.correct(longer(0.5))
    left = coverage.unlooked(WALL).p_w[:, 0]
    assert not ((left > 0.7) & (left < 1.3)).any()


def test_borders_are_where_the_free_space_ends_and_face_it():
    found = borders(corridor(), np.array([0.0, 0.0]))
    long = np.abs(found.p_w[:, 0]) < 3.0
    np.testing.assert_allclose(np.abs(found.p_w[long, 1]), 0.95, atol=0.11)
    facing = found.normal_w[long] @ [0.0, 1.0] * -np.sign(found.p_w[long, 1])
    assert facing.min() > 0.99
    assert long.sum() == pytest.approx(2 * 60, abs=4), "both sides"


def test_furniture_and_other_rooms_are_no_borders():
    """A chair; and space behind a wall, as rays through a window leave it."""
    chair = corridor(solid=lambda x, y: (np.abs(x - 1.0) < 0.2) & (np.abs(y) < 0.2))
    around = np.linalg.norm(borders(chair, np.array([0.0, 0.0])).p_w - [1.0, 0.0], axis=1)
    assert around.min() > 0.6
    beyond = corridor(free=lambda x, y: (np.abs(y) < 0.95) | ((y > 1.5) & (y < 2.5)))
    assert borders(beyond, np.array([0.0, 0.0])).p_w[:, 1].max() < 1.1
    assert borders(beyond, np.array([0.0, 2.0])).p_w[:, 1].min() > 1.2


def test_unknown_space_has_no_borders():
    nothing = corridor(free=lambda x, y: np.zeros(x.shape, bool))
    assert len(borders(nothing, np.array([0.0, 0.0])).p_w) == 0
    assert len(Coverage().unlooked(borders(nothing, np.array([0.0, 0.0]))).p_w) == 0
