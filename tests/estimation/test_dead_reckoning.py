"""A camera's place as the drone's sensors carry it on, against flights whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.dead_reckoning import REACH_S, reckoned
from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.estimation.telemetry.visual_memory import Sightings
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import EXACT, simulate

T_B_C = camera_on_body()
UNIT_M = 2.5


class Flight:
    """A swung camera in a map with axes and a unit of its own, and its telemetry."""

    def __init__(self, rng, motion, faults=EXACT, floor_m=0.0, height="tof", told=lambda sample: sample, **changes):
        samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=faults, floor_m=floor_m).samples()
        track = TelemetryTrack("world", 0.35)
        track.add([t for t in map(told, samples) if t is not None])
        forward = (motion.T_w_c[0, :3, :3] @ T_B_C[:3, :3].T)[:, 0]
        power_on = Rotation.from_euler("z", -np.arctan2(forward[1], forward[0])).as_matrix()
        turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
        self.stamps_s = motion.stamps_s
        self.true = motion.T_w_c[:, :3, 3] @ power_on.T / UNIT_M
        self._T = motion.T_w_c.copy()
        self._T[:, :3, 3] = self.true @ turn
        tie = {"delay_s": 0.0, "delay_sigma_s": 0.0, "scale_sigma_log": 0.02, "truncates": 0.0} | changes
        self.model = TelemetryModel(
            track, FusionConfig(), T_B_C, turn, scale=UNIT_M, velocity=True, height=height, **tie
        )

    def recent(self, k, moved=(0.0, 0.0, 0.0)):
        """Poses of the five seconds before frame ``k``, off by ``(3,)`` metres in the drone's axes."""
        rows = np.arange(max(0, k - round(20 * REACH_S)), k, 6)
        T = self._T[rows].copy()
        T[:, :3, 3] += np.array(moved) @ self.model.R_w_m / UNIT_M
        return Sightings(self.stamps_s[rows], T, np.full(len(rows), 0.01))

    def off_m(self, k):
        """How far what is told of frame ``k`` is off, and its doubt, ``(3,)`` each."""
        told = reckoned(self.model, self.recent(k), self.stamps_s[k])
        return UNIT_M * (told.centre - self.true[k]), UNIT_M * told.doubt

    def all_off_m(self):
        return np.array([self.off_m(k) for k in range(40, len(self.stamps_s) - 20, 7)])


def in_whole_steps(rounding):
    """Velocities in steps of .1 m/s, cut off or rounded, and angles in whole degrees."""
    whole = {"nearest": np.rint, "truncate": np.trunc}[rounding]
    degree = np.pi / 180.0

    def told(sample):
        v, rpy = whole(sample.velocity_m_s / 0.1) * 0.1, np.rint(sample.rpy_rad / degree) * degree
        return replace(sample, velocity_m_s=v, rpy_rad=rpy, height_m=np.trunc(10.0 * sample.height_m) / 10.0)

    return told


@pytest.mark.parametrize("height", [None, "tof"])
def test_exact_sensors_carry_it_to_where_it_is(rng, swinging, height):
    off, doubt = np.moveaxis(Flight(rng, swinging(16.0), height=height).all_off_m(), 1, 0)
    assert np.abs(off).max() < 0.02
    assert (doubt > 0.05).all() and doubt.max() < 0.25


def test_it_goes_on_from_where_the_map_has_it(rng, swinging):
    flight = Flight(rng, swinging(16.0))
    here, there = (
        reckoned(flight.model, flight.recent(200, moved), flight.stamps_s[200])
        for moved in ((0.0, 0.0, 0.0), (1.0, -2.0, 0.5))
    )
    np.testing.assert_allclose(UNIT_M * (there.centre - here.centre), [1.0, -2.0, 0.5], atol=1e-9)
    np.testing.assert_allclose(there.doubt, here.doubt, atol=1e-9)


@pytest.mark.parametrize("rounding", ["nearest", "truncate"])
@pytest.mark.parametrize("height", [None, "tof", "h", "baro"])
def test_the_doubt_covers_whole_decimetres(rng, swinging, rounding, height):
    """Rounded or cut off, and nobody knows which."""
    flight = Flight(rng, swinging(40.0), height=height, told=in_whole_steps(rounding), truncates=0.5)
    off, doubt = np.moveaxis(flight.all_off_m(), 1, 0)
    assert (np.abs(off) < doubt).mean() > 0.99


def test_an_even_flight_loses_nearly_a_step_all_the_time(rng, swinging):
    """At .185 m/s a velocity that is cut off says .1, and who takes it for rounded adds nothing."""
    motion = swinging(16.0)
    T_w_c = motion.T_w_c.copy()  # it looks about: a message that is repeated is none
    T_w_c[:, :3, 3] = [0.0, 0.0, 1.2] + motion.stamps_s[:, None] * [0.185, 0.185, 0.0]
    even = replace(motion, T_w_c=T_w_c)
    off, doubt = np.moveaxis(Flight(rng, even, told=in_whole_steps("truncate")).all_off_m(), 1, 0)
    assert (np.abs(off) < doubt).all()
    assert np.abs(off).max() > 0.05


def test_a_height_drifts_less_than_velocities_that_are_cut_off(rng, swinging):
    told = in_whole_steps("truncate")
    with_height, without = (
        Flight(rng, swinging(20.0), height=h, told=told).all_off_m()[:, :, 2] for h in ("tof", None)
    )
    assert np.abs(with_height[:, 0]).max() < 0.06
    assert with_height[:, 1].max() < without[:, 1].min() + 0.05


def test_a_step_of_the_floor_is_no_climb(rng, swinging):
    """A table of .7 m below for three seconds: velocities tell the height until it has been below for a second."""
    motion = swinging(20.0)
    floor_m = np.where((motion.stamps_s > 8.0) & (motion.stamps_s < 11.0), 0.7, 0.0)
    flight = Flight(rng, motion, floor_m=floor_m)
    for k in range(100, 300, 3):
        off, doubt = flight.off_m(k)
        assert np.abs(off[2]) < doubt[2] and doubt[2] < 0.25


def test_a_hole_in_the_telemetry_tells_nothing(rng, swinging):
    flight = Flight(rng, swinging(20.0), told=lambda sample: None if 9.0 < sample.stamp_s < 11.0 else sample)
    assert reckoned(flight.model, flight.recent(205), flight.stamps_s[205]) is None
    after = flight.off_m(290)
    assert np.abs(after[0]).max() < 0.02


def test_after_a_long_loss_it_is_in_more_doubt(rng, swinging):
    flight = Flight(rng, swinging(20.0), height=None)
    told = [reckoned(flight.model, flight.recent(200), flight.stamps_s[k]) for k in (202, 240)]
    assert (told[1].doubt > told[0].doubt + 0.15 / UNIT_M).all()
    assert np.abs(told[1].centre - flight.true[240]).max() < 0.03 / UNIT_M


@pytest.mark.parametrize(("changes", "more"), [({"delay_sigma_s": 0.2}, 0.01), ({"scale_sigma_log": 0.1}, 0.002)])
def test_what_is_not_known_is_doubt(rng, swinging, changes, more):
    seed = int(rng.integers(1 << 30))
    sure, unsure = (
        Flight(np.random.default_rng(seed), swinging(16.0), **c).all_off_m()[:, 1].mean(axis=0) for c in ({}, changes)
    )
    assert (unsure > sure + more).all()


def test_a_video_that_is_late_shows_what_was_told_before(rng, swinging):
    faults = replace(EXACT, video_delay_s=0.4)
    flight = Flight(rng, swinging(16.0), faults, delay_s=0.4, height=None)
    off = flight.all_off_m()[:, 0]
    wrong = Flight(rng, swinging(16.0), faults, delay_s=0.0, height=None).all_off_m()[:, 0]
    assert np.abs(off).max() < 0.05 < 0.1 < np.abs(wrong).max()


def test_a_flight_is_not_reckoned_before_its_telemetry_is_proven(rng, swinging, replay):
    """In a map of its own gauge; afterwards the truth is within the doubt."""
    motion = swinging(24.0)
    gauge = motion.in_gauge(rng)
    fusion, told = MotionFusion(FusionConfig(), T_B_C), []
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C).samples()

    def each(t, i):
        place = fusion.reckoned(t)
        off = None if place is None else place.R_w_m @ gauge.T_m_c[i, :3, 3] - place.centre
        told.append(None if off is None else np.abs(off) < place.doubt)

    replay(fusion, motion, gauge, samples, each=each)
    assert all(one is None for one in told[:60])
    late = [one for one in told[300:-20] if one is not None]
    assert len(late) > 100
    assert np.mean(late) > 0.98


def test_telemetry_of_another_flight_reckons_nothing(rng, swinging, replay):
    motion = swinging(24.0)
    fusion, told = MotionFusion(FusionConfig(delay_s=0.5), T_B_C), []
    backwards = simulate(rng, motion.stamps_s, motion.T_w_c[::-1], T_B_C).samples()
    replay(fusion, motion, motion.in_gauge(rng), backwards, each=lambda t, i: told.append(fusion.reckoned(t)))
    assert told.count(None) == len(told)


@pytest.mark.parametrize("sources", [["height"], ["telemetry", "height"]], ids="+".join)
def test_velocities_on_which_no_metres_rest_carry_nothing(rng, swinging, replay, sources):
    """Heights told the metres alone, and nothing has compared the velocities with them: they may be cm/s."""
    motion = swinging(24.0)
    fusion = MotionFusion(FusionConfig(), T_B_C)
    replay(fusion, motion, motion.in_gauge(rng), simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C).samples())
    last_s = float(motion.stamps_s[-20])
    assert fusion.reckoned(last_s) is not None
    found = {source: replace(fusion.metres.sensor_scale, source=source) for source in sources}
    fusion.metres.take(found, None, fusion.flight.trust)
    assert (fusion.reckoned(last_s) is None) == (sources == ["height"])
