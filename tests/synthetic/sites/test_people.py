"""People who walk."""

import numpy as np
import pytest

from edgeslam_torch.drone.emulator.drone import DroneModel, Mode
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.views import look
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.synthetic.sites.build import named_site
from edgeslam_torch.synthetic.sites.people import walker

CAMERA = Camera(80, 60, 50.0, 50.0, 39.5, 29.5)


@pytest.fixture
def person(rng):
    return walker(rng, np.array([[1.0, 2.0], [1.0, 5.0]]), 0.5)


def test_a_walker_turns_round_at_both_ends_and_keeps_the_speed(person):
    there_s = 3.0 / 0.5
    begin_s = -person.first_s
    for after_s, y, heading in ((0.0, 2.0, np.pi / 2), (2.0, 3.0, np.pi / 2), (there_s + 2.0, 4.0, 3 * np.pi / 2)):
        place, yaw = person.at(begin_s + after_s)
        np.testing.assert_allclose(place, [1.0, y], atol=1e-9)
        assert yaw == pytest.approx(heading)
    steps = np.array([person.at(t)[0] for t in np.arange(0.0, 30.0, 0.1)])
    assert np.linalg.norm(np.diff(steps, axis=0), axis=1).max() < 0.0501


def test_a_walker_is_as_far_away_as_their_shoulder(person):
    at_s = 2.0 - person.first_s  # at (1, 3), facing +y: half a shoulder's breadth of 25 cm lies along x
    away = person.distance(np.array([[2.0, 3.0, 1.1], [1.0, 3.0, 1.1], [1.0, 4.0, 1.1]]), at_s)
    np.testing.assert_allclose(away, [0.75, 0.0, 0.88], atol=1e-9)


def test_people_are_seen_and_felt_where_they_are_now():
    site = named_site("people", 1)
    walkers = site.walkers
    for at_s in (0.0, 3.0):
        (x, y), _ = walkers[0].at(at_s)
        T = look(np.array([x - 2.0, y, 1.1]), 0.0)
        depth = render(site.painted(at_s), CAMERA, T).depth_m[30, 40]
        assert 1.5 < depth < 1.95  # half their breadth or depth nearer than their middle
        hit = (np.array([x - 2.0 + depth, y, 1.1]) - site.T_site_w[:3, 3]) @ site.T_site_w[:3, :3]
        assert site.clearance(hit[None], at_s)[0] < 0.02
        assert site.clearance(hit[None])[0] > 0.2, "without a time, only what stands still"
    assert len(site.painted(0.0).quads) > len(site.world.quads)


def test_a_hovering_drone_is_hit_by_who_walks_into_it(person):
    drone = DroneModel()
    drone.clearance = lambda p: float(person.distance(p[None] + [1.0, 4.0, 0.2], drone.clock_s)[0])
    drone.mode, drone.p_w = Mode.FLYING, np.array([0.0, 0.0, 1.0])
    while not drone.contacts and drone.clock_s < 20.0:
        drone.step(0.01)
    (contact,) = drone.contacts
    assert contact.speed_m_s == pytest.approx(0.5, abs=0.05), "the walker's speed; the drone hovers"
    assert not contact.crashed


def test_a_walker_is_painted_where_they_can_be_hit(person):
    for at_s in (0.0, 4.3, 9.1):
        corners = World(person.painted(at_s)).corners_w.reshape(-1, 3)
        assert person.distance(corners, at_s).max() < 1e-9
