"""The Kalman filter predicts the camera: for tracking, through outages, and at the present moment."""

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp
from swung import T_B_C, replay, swinging

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.estimation.snapshot import Present
from edgeslam_torch.estimation.telemetry_scale import TelemetryScale
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import rotation_vector
from edgeslam_torch.synthetic.flights.telemetry import EXACT, TelemetryFaults, simulate

DELAY_S = 0.4
LATE = replace(EXACT, video_delay_s=DELAY_S)
"""Exact telemetry, delayed video."""
KNOWN = FusionConfig(delay_s=DELAY_S)
FIRST_S = 12.0
"""Scale is known by then."""


def true_pose(motion, stamp_s):
    """``T_w_c`` at a stamp of the frames' clock."""
    T = np.eye(4)
    T[:3, :3] = Slerp(motion.stamps_s, Rotation.from_matrix(motion.T_w_c[:, :3, :3]))(stamp_s).as_matrix()
    T[:3, 3] = [np.interp(stamp_s, motion.stamps_s, p) for p in motion.T_w_c[:, :3, 3].T]
    return T


class Flown:
    """A swung camera, its telemetry and a fusion that is asked on the way."""

    def __init__(self, rng, motion, faults=LATE, config=KNOWN, noise=(0.001, 0.0005)):
        self.motion, self.config = motion, config
        self.gauge = motion.in_gauge(rng, *noise)
        self.samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=faults).samples()
        self.fusion = MotionFusion(config, T_B_C)

    def run(self, each=lambda i, t: None, until_s=np.inf):
        """Frames and packets in order of arrival; ``each`` is called after the packets, before the frame."""
        seen = replace(self.motion, stamps_s=self.motion.stamps_s[self.motion.stamps_s <= until_s])
        replay(self.fusion, seen, self.gauge, self.samples, each=lambda t, i: each(i, t))
        return self

    def fly_on(self, until_s, leap=None, size=1.0):
        """On from the last frame, in a map that is moved by ``leap`` or is of another ``size``."""
        from_s = max(15.0, self.fusion.flight.memory.last.stamp_s)
        for i in np.flatnonzero((self.motion.stamps_s > from_s) & (self.motion.stamps_s < until_s)):
            t, gauge = float(self.motion.stamps_s[i]), self.gauge
            self.fusion.add_telemetry([s for s in self.samples if t - 0.05 < s.stamp_s <= t])
            T_m_c = gauge.T_m_c[i].copy() if leap is None else leap @ gauge.T_m_c[i]
            T_m_c[:3, 3] *= size
            self.fusion.add_visual(t, T_m_c, gauge.sigma_t, gauge.sigma_r)

    def off_m(self, T_m_c, stamp_s):
        """Metres from a pose in the map to the truth at a stamp of the frames' clock."""
        truth = self.gauge.T_m_w @ true_pose(self.motion, stamp_s)
        return float(np.linalg.norm(T_m_c[:3, 3] * self.gauge.scale - truth[:3, 3]))

    def metric(self):
        """What `EdgeSlam` would publish, in metres of the true scale."""
        return Present(self.fusion.snapshot(), OutputFrame(self.gauge.scale), True)


@pytest.fixture(scope="module")
def at_15_s():
    return Flown(np.random.default_rng(0), swinging(20.0)).run(until_s=15.0)


@pytest.fixture
def flown(at_15_s):
    """A flight after 15 s; each test has its own."""
    return deepcopy(at_15_s)


def test_the_filter_predicts_the_pose_of_the_next_frame(rng):
    """Telemetry is ahead of the video: what the camera will have done is known. Any flipped sign doubles the way."""
    flown = Flown(rng, swinging(18.0))
    told, still = ({frames: [] for frames in (1, 4, 8)} for _ in range(2))

    def each(i, t):
        if t < FIRST_S or i % 5:
            return
        for frames in told:
            if i + frames < len(flown.motion.stamps_s):
                ahead_s = float(flown.motion.stamps_s[i + frames - 1])
                told[frames].append(flown.off_m(flown.fusion.predict(ahead_s).T_w_c, ahead_s))
                still[frames].append(flown.off_m(flown.gauge.T_m_c[i - 1], ahead_s))

    flown.run(each)
    for frames, errors in told.items():
        assert len(errors) > 20
        assert np.median(errors) < 0.12 * np.median(still[frames]) + 0.002
        assert np.max(errors) < 0.3 * np.max(still[frames]) + 0.004


def test_an_outage_of_vision_is_bridged_and_said(rng):
    """10, 30 and 100 frames without an image: error and sigma grow together."""
    flown = Flown(rng, swinging(17.5), faults=TelemetryFaults(video_delay_s=DELAY_S))
    flown.run(until_s=14.0)
    sigmas = []
    for gap_s in (0.3, 1.0, 3.0):
        flown.fusion.add_telemetry([s for s in flown.samples if s.stamp_s <= 14.0 + gap_s])
        estimate = flown.fusion.predict(14.0 + gap_s)
        sigma_m = estimate.sigma_t * flown.gauge.scale
        assert flown.off_m(estimate.T_w_c, 14.0 + gap_s) < 4.0 * np.sqrt(3.0) * sigma_m
        sigmas.append(sigma_m)
    assert sigmas[0] < sigmas[1] < sigmas[2] < 0.2


def test_a_map_that_is_moved_moves_the_prediction_along(flown):
    """A refinement shifts the newest poses although the camera has not moved."""
    before = flown.fusion.predict(15.2).T_w_c
    T = se3.exp(np.array([0.3, -0.1, 0.2, 0.1, -0.2, 0.3]))
    flown.fusion.map_moved(T)
    np.testing.assert_allclose(flown.fusion.predict(15.2).T_w_c, T @ before, atol=1e-9)


def predicted_at(flown, stamp_s):
    """Where submap 1 begins: the filter's pose and its sigmas."""
    predicted = flown.fusion.predict(stamp_s)
    return 1, stamp_s, predicted.T_w_c, predicted.sigma_t, predicted.sigma_r_rad


def test_the_present_of_a_new_piece_of_map_is_where_it_begins(flown):
    """Not where the camera was tracked last; tracked frames follow."""
    begun = predicted_at(flown, 15.3)
    flown.fusion.begin_piece(*begun)
    for at_s in (15.3, 15.4):
        T_w_c = begun[2] @ se3.exp(np.array([at_s - 15.0, 0.0, 0.0, 0.0, at_s - 15.0, 0.0]))
        flown.fusion.follow_start(at_s, T_w_c)
        now = Present(flown.fusion.snapshot()).pose_at(at_s + 0.05)
        np.testing.assert_allclose(now.T_w_c, T_w_c, atol=1e-9)
        assert now.covariance[0, 0] >= begun[3] ** 2 and now.seen_s == at_s
        np.testing.assert_allclose(flown.fusion.begun.T_w_c, T_w_c, atol=1e-9)
    flown.fly_on(18.0)
    assert flown.fusion.begun is None, "it has a map, or the camera is back in an earlier one"
    assert Present(flown.fusion.snapshot()).pose_at(18.0).seen_s > 17.5


@pytest.mark.parametrize("size", [0.6, 1.0, 1.8])
def test_a_new_piece_of_map_has_a_scale_of_its_own(flown, size):
    """It says nothing of the map before it, and is uncertain until sensors have measured it."""
    before = flown.fusion.scale()
    flown.fusion.begin_piece(*predicted_at(flown, 15.1))
    uncertain = flown.fusion.health(15.1, "tracking", True).scale
    assert uncertain == flown.fusion.scale()
    assert uncertain.sigma > 0.2 * uncertain.value and not flown.fusion.submap.is_known
    leaning = OutputFrame(3.0, se3.exp(np.array([0.0, 0.0, 0.0, 0.2, 0.0, 0.0]))[:3, :3])
    assert flown.fusion.republished(leaning) is leaning
    flown.fly_on(20.0, size=size)
    assert flown.fusion.submap.is_known
    assert flown.fusion.submap.growth == pytest.approx(1.0 / size, rel=0.05)
    flown.fusion.enter(0)
    assert flown.fusion.scale() == before
    assert flown.fusion.health(20.0, "tracking", True).scale == before


def test_attitude_is_not_blamed_for_the_heading_at_which_a_piece_begins(flown):
    """It was predicted while nothing was tracked; sensors measure the piece all the same."""
    T_m_w = flown.gauge.T_m_w
    turned = T_m_w @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.6])) @ se3.inverse(T_m_w)
    before = flown.fusion.up()
    flown.fusion.begin_piece(*predicted_at(flown, 15.1))
    np.testing.assert_array_equal(flown.fusion.up().direction, before.direction)
    assert flown.fusion.up().sigma_rad == before.sigma_rad, "without a pose in the piece"
    flown.fly_on(20.0, turned, size=2.0)
    assert flown.fusion.flight.trust.turns
    assert flown.fusion.submap.growth == pytest.approx(0.5, rel=0.05)


def test_the_camera_may_return_to_a_piece_and_leave_it_again(flown):
    """Each keeps its heading, and a scale that is uncertain until sensors have measured it."""
    T_m_w = flown.gauge.T_m_w
    turned = T_m_w @ se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.6])) @ se3.inverse(T_m_w)
    fusion, before, begun = flown.fusion, flown.fusion.scale(), predicted_at(flown, 15.1)
    fusion.begin_piece(*begun)
    flown.fly_on(15.5, turned)
    fusion.begin_piece(2, 15.5, *begun[2:])
    flown.fly_on(15.9, size=1.5)
    for piece, leap in ((0, None), (1, turned), (2, None), (0, None)):
        fusion.enter(piece)
        uncertain = fusion.scale().sigma > 0.2 * fusion.scale().value
        assert uncertain == (piece > 0) and (fusion.submap is None) == (piece == 0)
        flown.fly_on(flown.fusion.flight.memory.last.stamp_s + 0.5, leap, size=1.5 if piece == 2 else 1.0)
        assert fusion.flight.trust.turns and fusion.flight.trust.velocity
        off = fusion.orientation.R_w_m @ (T_m_w if leap is None else leap @ T_m_w)[:3, :3]
        assert np.linalg.norm(rotation_vector(off)) < 0.05
    assert fusion.scale().value == pytest.approx(before.value, rel=0.01)


def test_pieces_that_were_merged_are_of_the_maps_unit(flown):
    flown.fusion.begin_piece(*predicted_at(flown, 15.1))
    flown.fly_on(16.0)
    flown.fusion.begin_piece(2, *predicted_at(flown, 16.0)[1:])
    flown.fly_on(16.5)
    flown.fusion.join(lambda piece: min(piece, 1))
    assert flown.fusion.submaps.keys() == {1}, "neither was measured"
    flown.fusion.join(lambda piece: 0)
    assert not flown.fusion.submaps and flown.fusion.submap is None
    assert len(flown.fusion.flight.memory.newest().stamps_s) == len(flown.fusion.flight.memory.sightings().stamps_s)


def test_a_scale_that_one_fit_did_not_determine_is_looked_for_again_soon(flown, monkeypatch):
    """The longer the flight, the rarer are fits: this one would hover for a tenth of its time without metres."""
    flown.fly_on(17.0)
    fit, results = TelemetryScale.beliefs, [({}, None)]
    monkeypatch.setattr(TelemetryScale, "beliefs", lambda self: results.pop() if results else fit(self))
    known = [flown.fusion.metres.sensor_scale is not None]
    for until_s in np.arange(17.0, 20.0, 0.1):
        flown.fly_on(float(until_s))
        known.append(flown.fusion.metres.sensor_scale is not None)
    assert known[0] and known[-1] and 0 < np.sum(~np.array(known)) < 12


def test_a_piece_that_begins_in_a_new_one_is_of_the_same_map(flown):
    """Its scale before is that of the first."""
    before = flown.fusion.metres.sensor_scale
    flown.fusion.begin_piece(*predicted_at(flown, 15.1))
    flown.fly_on(16.0, size=3.0)
    flown.fusion.begin_piece(2, *predicted_at(flown, 16.0)[1:])
    assert flown.fusion.submap.before == before and flown.fusion.submap.measured is None


def test_a_new_piece_of_map_is_no_motion(flown):
    flown.fusion.begin_piece(*predicted_at(flown, 15.1))
    assert not flown.fusion.filtering
    leap = se3.exp(np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
    flown.fly_on(18.0, leap)
    counts = flown.fusion.statistics()
    assert counts.get("ekf visual recovered", 0) == 0
    assert flown.off_m(se3.inverse(leap) @ flown.fusion.predict(18.1).T_w_c, 17.95) < 0.1


def test_telemetry_that_the_caller_holds_carries_the_present_on(flown):
    """State messages that arrived since the last step, without telling the fusion."""
    newer = [s for s in flown.samples if 15.0 < s.stamp_s <= 15.8]
    present = flown.metric()
    told = present.pose_at(15.8, newer)
    assert told.source == "filter"
    scaled = told.T_w_c / np.array([[1, 1, 1, flown.gauge.scale]])
    assert flown.off_m(scaled, 15.8 + DELAY_S) < 0.02
    assert told.stamp_s == pytest.approx(15.8, abs=0.02)
    later, before = (true_pose(flown.motion, 15.8 + DELAY_S + s)[:3, 3] for s in (0.05, -0.05))
    np.testing.assert_allclose(told.velocity_w, flown.gauge.T_m_w[:3, :3] @ (later - before) / 0.1, atol=0.1)
    assert present.pose_at(15.8).source == "visual", "telemetry ends too early"


def test_a_snapshot_answers_the_same_while_the_flight_goes_on(flown):
    present = flown.metric()
    first = present.pose_at(15.2)
    flown.fly_on(17.0)
    again = present.pose_at(15.2)
    np.testing.assert_array_equal(again.T_w_c, first.T_w_c)
    np.testing.assert_array_equal(again.covariance, first.covariance)


def test_without_telemetry_the_present_is_constant_velocity():
    motion = swinging(2.0)
    fusion = MotionFusion(FusionConfig(), T_B_C)
    assert Present(fusion.snapshot()).pose_at(0.0) is None
    for t, T in zip(motion.stamps_s, motion.T_w_c, strict=True):
        fusion.add_visual(float(t), T, 0.001, 0.001)
    now = Present(fusion.snapshot()).pose_at(float(motion.stamps_s[-1]) + 0.05)
    assert (now.source, now.metric) == ("visual", False)
    ahead = 2.0 * motion.T_w_c[-1, :3, 3] - motion.T_w_c[-2, :3, 3]
    np.testing.assert_allclose(now.T_w_c[:3, 3], ahead, atol=1e-9)
    np.testing.assert_allclose(now.velocity_w, (motion.T_w_c[-1] - motion.T_w_c[-2])[:3, 3] / 0.05, atol=1e-9)
