"""Worlds of scenes: free where they say so, solid where something is seen, doors as wide as written."""

import numpy as np
import pytest

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.flights.courses import BUILDING_M
from edgeslam_torch.synthetic.flights.flight import FlightPlan, fly
from edgeslam_torch.synthetic.flights.paths import around
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.views import look
from edgeslam_torch.synthetic.sites.build import JUDGED, named_site, place
from edgeslam_torch.synthetic.sites.obstacles import PASSAGE_M

CAMERA = Camera(80, 60, 50.0, 50.0, 39.5, 29.5)
FLAT = """
start = [0.8, 2, 90]
way = [[0.8, 2], [4.2, 1.4], [6.0, 1.4], [6.0, 5.2]]
height = 3.0
walls = ["bricks"]
room = [{ name = "a", x = [0, 5], y = [0, 4] }, { name = "b", x = [5, 7], y = [0, 6] }]
door = [{ between = ["a", "b"], at = 1.4, width = 1.1 }, { between = ["a", "b"], at = 3, open = false }]
"""


@pytest.fixture
def flat(tmp_path):
    (tmp_path / "flat.toml").write_text(FLAT)
    return named_site(str(tmp_path / "flat.toml"), 0)


def free_at(site, p):
    """Distance [m] of a point in the scene's axes to the nearest solid."""
    return float(site.world.distance_to_solid(np.array([p], float))[0])


@pytest.mark.parametrize(
    ("p", "away"),
    [
        ((1.5, 2.0, 1.6), 1.4),  # floors are stood upon; the ceiling is 3 m high
        ((4.5, 2.2, 1.0), 0.44),  # the wall between the rooms is 12 cm thick
        ((5.0, 1.4, 1.0), 0.55),  # in the door
        ((5.0, 1.4, 2.3), 0.0),  # above the door
        ((5.0, 3.0, 1.0), 0.0),  # the shut door
        ((2.5, 5.0, 1.5), 0.0),  # in no room
        ((6.5, 5.0, 1.0), 0.5),
    ],
)
def test_walls_and_doors_stand_where_they_are_written(flat, p, away):
    assert free_at(flat, p) == pytest.approx(away, abs=0.035)  # frames and skirting boards


@pytest.mark.parametrize("style", ["furniture", "corridor"])
def test_nothing_stands_in_the_doors_of_a_dressed_wall(tmp_path, style):
    dress = f'dress = [{{ room = "a", walls = ["east"], style = "{style}", density = 1.0 }}]'
    (tmp_path / "dressed.toml").write_text(FLAT + dress)
    for seed in range(3):
        site = named_site(str(tmp_path / "dressed.toml"), seed)
        assert free_at(site, (5.0, 1.4, 1.0)) == pytest.approx(0.55, abs=0.035)
        assert free_at(site, (4.7, 1.4, 0.8)) > 0.5


@pytest.mark.parametrize("name", ["blank_walls", "corridor", "l_corridor", "t_corridor"])
def test_start_and_goal_are_free_and_the_same_seed_gives_the_same_site(name):
    site, again = named_site(name, 3), named_site(name, 3)
    above = np.array([[0.0, 0.0, z] for z in np.linspace(0.1, 1.2, 12)])
    assert site.clearance(np.vstack([above, site.goal_w])).min() > PASSAGE_M - 0.1
    assert again.world.corners_w.tobytes() == site.world.corners_w.tobytes()
    assert named_site(name, 4).world.corners_w.shape != site.world.corners_w.shape or name == "blank_walls"


@pytest.mark.parametrize("name", ["blank_walls", "l_corridor"])
def test_what_a_camera_sees_can_be_hit(name):
    """Rays to seen surfaces end within a centimetre of a solid: the renderer and the judge agree."""
    site = named_site(name, 1)
    for yaw in (0.0, 1.3, 2.6):
        T_w_c = look(site.in_site(np.array([1.0, 0.1, 1.1])), yaw)
        depth = render(site.world, CAMERA, T_w_c).depth_m
        v, u = np.mgrid[2:60:9, 2:80:9]
        rays = CAMERA.back_project(np.stack([u.ravel(), v.ravel()], 1), depth[v, u].ravel().astype(float))
        hits = rays @ T_w_c[:3, :3].T + T_w_c[:3, 3]
        assert site.world.distance_to_solid(hits[hits[:, 2] > 0.05]).max() < 0.01


@pytest.mark.parametrize("seed", [0, 2])
def test_open_doors_are_exits_and_the_others_are_shut(seed):
    site = named_site("doors", seed)
    for way_out in site.exits:
        assert site.clearance(way_out.centre_w[None])[0] == pytest.approx(0.5 * way_out.width_m, abs=0.05)
        assert way_out.normal_w == pytest.approx([0.0, 1.0, 0.0]), "away from the corridor"
    along = np.linspace(0.2, 9.6, 600)
    line = np.stack([along, np.full(600, site.exits[0].centre_w[1]), np.full(600, 1.0)], axis=1)
    free = site.clearance(line) > 0.3
    assert np.count_nonzero(np.diff(free.astype(int)) == 1) + free[0] == len(site.exits) == 2


def test_glass_is_hit_and_not_seen():
    site = named_site("glass", 0)
    wide = site.world.bounds_w[1, 1]
    hit = [free_at(site, (6.0, side * wide / 2, 1.5)) == 0 for side in (-1, 1)]
    assert sorted(hit) == [False, True]
    y = wide / 2 * (1 if hit[1] else -1)
    seen = render(site.world, CAMERA, look(np.array([5.0, y, 1.5]), 0.0)).depth_m[30, 40]
    assert seen > 2.0


def test_the_drone_starts_at_the_origin_of_its_own_world(flat):
    assert flat.in_site(np.zeros(3)) == pytest.approx([0.8, 2.0, 0.0])
    assert flat.in_site(flat.goal_w) == pytest.approx([6.0, 5.2, 1.1])
    (way_out,) = flat.exits
    assert flat.in_site(way_out.centre_w) == pytest.approx([5.0, 1.4, 1.025])
    assert way_out.width_m == 1.1 and way_out.normal_w == pytest.approx([0.0, -1.0, 0.0])


@pytest.mark.slow
@pytest.mark.parametrize("name", JUDGED)
def test_seeds_of_a_judged_site_can_be_built(name):
    for seed in range(6):
        site = named_site(name, seed)
        assert site.clearance(site.goal_w[None])[0] > PASSAGE_M - 0.1


@pytest.mark.slow
def test_the_line_through_the_building_is_free_and_leads_into_all_ten_rooms():
    rng = np.random.default_rng(0)
    world = place("building", rng)
    flight = fly(rng, world, 840, around(BUILDING_M), rate_hz=15.0, plan=FlightPlan(speed_m_s=0.8))
    p = flight.T_w_b[:, :3, 3]
    assert world.clearance(p).min() > 0.3
    rooms = {(int(column), bool(row > 0)) for column, row in zip(np.floor(p[:, 0] / 4.0 + 2.5), p[:, 1], strict=True)}
    assert rooms == {(column, row) for column in range(5) for row in (False, True)}
