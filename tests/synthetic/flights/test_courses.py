"""Kinds of simulated flights: what each of them is there for."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.synthetic.flights.courses import BLOCK_M, COURSES, RATE_HZ
from edgeslam_torch.synthetic.flights.flight import FlightPlan
from edgeslam_torch.synthetic.sites.build import place

built = cache(lambda scene: place(scene, np.random.default_rng(1)))
"""Most courses fly through the same room."""


@cache
def flight_of(name):
    course = COURSES[name]
    world = built(course.scene)
    return world, course.fly(np.random.default_rng(1), world, round(course.seconds * course.rate_hz))


def turned_deg(flight):
    """Angle from each frame to the next [deg]."""
    R = flight.T_w_c[:, :3, :3]
    return np.degrees(Rotation.from_matrix(np.swapaxes(R[:-1], 1, 2) @ R[1:]).magnitude())


def path_m(flight):
    return float(np.linalg.norm(np.diff(flight.T_w_b[:, :3, 3], axis=0), axis=1).sum())


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] if n.startswith(("building", "block")) else []) for n in COURSES]
)
def test_course_keeps_clear_of_walls_and_furniture(name):
    world, flight = flight_of(name)
    assert world.clearance(flight.T_w_b[:, :3, 3]).min() > 0.3
    assert len(flight.stamps_s) == COURSES[name].seconds * COURSES[name].rate_hz and flight.stamps_s[0] == 0


def test_block_is_flown_once_around_and_the_beginning_again():
    """Along the sides of the rectangle, looking where it flies."""
    _, flight = flight_of("block")
    p = flight.T_w_b[:, :3, 3]
    yaw = np.unwrap(np.arctan2(flight.T_w_c[:, 1, 2], flight.T_w_c[:, 0, 2]))
    assert np.degrees(yaw[-1] - yaw[0]) == pytest.approx(360.0, abs=20.0), "the wall of the block is always at the left"
    assert path_m(flight) == pytest.approx(45.0, abs=1.0)
    again = np.linalg.norm(p[-1] - p, axis=1)[: len(p) // 2]
    assert again.min() < 0.4, "height and distance from the line differ"
    assert np.degrees(np.abs(np.gradient(yaw, flight.stamps_s))).max() < 45.0
    outer = np.abs(p[:, :2]) - 0.5 * np.array(BLOCK_M)
    assert np.abs(outer.max(axis=1)).max() < 0.5, "on one side or the other"
    way = np.arctan2(flight.velocity_w[:, 1], flight.velocity_w[:, 0])
    fast = np.linalg.norm(flight.velocity_w[:, :2], axis=1) > 0.3
    off = np.abs((yaw - way + np.pi) % (2 * np.pi) - np.pi)[fast]
    assert np.degrees(np.percentile(off, 95)) < 35.0


def test_climb_is_straight_up_and_down():
    _, flight = flight_of("climb")
    p = flight.T_w_b[:, :3, 3]
    wobble = 3 * FlightPlan().wobble_m
    assert np.ptp(p[:, :2], axis=0).max() < 2 * wobble
    assert p[:, 2].min() < 0.45 and p[:, 2].max() > 1.9
    assert path_m(flight) > 5


def test_yaw_turns_more_than_once_on_the_spot():
    _, flight = flight_of("yaw")
    assert turned_deg(flight).sum() > 400
    assert np.ptp(flight.T_w_b[:, :3, 3], axis=0).max() < 0.25


@pytest.mark.parametrize(("name", "min_deg", "max_deg"), [("turn_first", 30, 40), ("hover_first", 0, 6)])
def test_first_second_goes_nowhere_and_the_rest_is_a_flight(name, min_deg, max_deg):
    _, flight = flight_of(name)
    second = round(RATE_HZ)
    p = flight.T_w_b[:, :3, 3]
    assert np.ptp(p[: second + 1], axis=0).max() < 0.03
    assert min_deg <= turned_deg(flight)[:second].sum() <= max_deg
    assert path_m(flight) > 6.0
