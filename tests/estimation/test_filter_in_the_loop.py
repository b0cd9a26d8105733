"""The Kalman filter predicts the camera: for tracking, through outages, and at the present moment."""

import threading
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.filter.delayed import BufferedEkf, PoseSigma
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.estimation.snapshot import Present
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import EXACT, TelemetryFaults, simulate
from edgeslam_torch.types import TelemetrySample

T_B_C = camera_on_body()
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

    def run(self, each=lambda i, t: None, until_s=np.inf, tracked=lambda t: True):
        """Frames and packets in order of arrival; ``each`` is called after the packets, before the frame."""
        sent = 0
        for i, t in enumerate(self.motion.stamps_s):
            if t > until_s:
                break
            end = sent
            while end < len(self.samples) and self.samples[end].stamp_s <= t:
                end += 1
            self.fusion.add_telemetry(self.samples[sent:end])
            sent = end
            each(i, float(t))
            gauge = self.gauge
            self.fusion.add_visual(float(t), gauge.T_m_c[i], gauge.sigma_t, gauge.sigma_r, tracked(float(t)))
        return self

    def off_m(self, T_m_c, stamp_s):
        """Metres from a pose in the map to the truth at a stamp of the frames' clock."""
        truth = self.gauge.T_m_w @ true_pose(self.motion, stamp_s)
        return float(np.linalg.norm(T_m_c[:3, 3] * self.gauge.scale - truth[:3, 3]))

    def metric(self):
        """What `EdgeSlam` would publish, in metres of the true scale."""
        return Present(self.fusion.snapshot(), OutputFrame(self.gauge.scale), True)


@pytest.fixture(scope="module")
def at_15_s(swinging):
    return Flown(np.random.default_rng(0), swinging(20.0)).run(until_s=15.0)


@pytest.fixture
def flown(at_15_s):
    """A flight after 15 s; each test has its own."""
    return deepcopy(at_15_s)


def test_the_filter_predicts_the_pose_of_the_next_frame(rng, swinging):
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


def test_an_outage_of_vision_is_bridged_and_said(rng, swinging):
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


def test_the_present_pose_makes_up_for_the_delay(rng, swinging):
    """Against the truth at the moment of asking, 0.4 s after what the newest frame shows."""
    flown = Flown(rng, swinging(18.0, 20.0, 0.25), faults=TelemetryFaults(video_delay_s=DELAY_S))
    off, late, slow = [], [], []

    def each(i, t):
        if t < FIRST_S or t + DELAY_S > flown.motion.stamps_s[-1] - 0.1:
            return
        now = flown.metric().pose_at(t)
        assert now.source == "filter"
        assert now.stamp_s == pytest.approx(t, abs=0.02)
        off.append(flown.off_m(now.T_w_c / np.array([[1, 1, 1, flown.gauge.scale]]), t + DELAY_S))
        late.append(flown.off_m(flown.gauge.T_m_c[i - 1], t + DELAY_S))
        step = (true_pose(flown.motion, t + DELAY_S + 0.05) - true_pose(flown.motion, t + DELAY_S - 0.05))[:3, 3] / 0.1
        slow.append(np.linalg.norm(now.velocity_w - flown.gauge.T_m_w[:3, :3] @ step))

    flown.run(each)
    assert np.median(late) > 0.12
    assert np.median(off) < 0.04
    assert np.max(off) < 0.1
    assert np.median(slow) < 0.12


@pytest.mark.slow
def test_the_printed_filter_stays_selectable_and_says_something_else(rng, swinging):
    answers = []
    for literal in (False, True):
        flown = Flown(np.random.default_rng(3), swinging(16.0), config=replace(KNOWN, literal=literal))
        now = flown.run(until_s=15.0).metric().pose_at(15.0)
        assert now.source == "filter"
        answers.append(now)
    apart = np.linalg.norm(answers[0].T_w_c[:3, 3] - answers[1].T_w_c[:3, 3])
    assert 1e-4 < apart < 0.5


def test_a_map_that_is_moved_moves_the_prediction_along(flown):
    """A refinement shifts the newest poses although the camera has not moved."""
    before = flown.fusion.predict(15.2).T_w_c
    T = se3.exp(np.array([0.3, -0.1, 0.2, 0.1, -0.2, 0.3]))
    flown.fusion.map_moved(T)
    np.testing.assert_allclose(flown.fusion.predict(15.2).T_w_c, T @ before, atol=1e-9)


def test_a_new_piece_of_map_is_no_motion(flown):
    flown.fusion.begin_piece()
    assert not flown.fusion.filtering
    leap = se3.exp(np.array([0.0, 3.0, 0.0, 0.0, 0.0, 0.0]))
    for i in np.flatnonzero((flown.motion.stamps_s > 15.0) & (flown.motion.stamps_s < 18.0)):
        t = float(flown.motion.stamps_s[i])
        flown.fusion.add_telemetry([s for s in flown.samples if t - 0.05 < s.stamp_s <= t])
        flown.fusion.add_visual(t, leap @ flown.gauge.T_m_c[i], flown.gauge.sigma_t, flown.gauge.sigma_r)
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
    assert present.pose_at(15.8).source == "visual", "telemetry ends too early"


def test_an_answer_is_the_same_whatever_other_threads_do(flown):
    """One thread flies on, three ask the same snapshot."""
    present, answers = flown.metric(), []
    first = present.pose_at(15.2)

    def ask():
        for _ in range(20):
            answers.append(present.pose_at(15.2))

    threads = [threading.Thread(target=ask) for _ in range(3)]
    for thread in threads:
        thread.start()
    for i in np.flatnonzero((flown.motion.stamps_s > 15.0) & (flown.motion.stamps_s < 17.0)):
        t = float(flown.motion.stamps_s[i])
        flown.fusion.add_telemetry([s for s in flown.samples if t - 0.05 < s.stamp_s <= t])
        flown.fusion.add_visual(t, flown.gauge.T_m_c[i], flown.gauge.sigma_t, flown.gauge.sigma_r)
    for thread in threads:
        thread.join()
    assert len(answers) == 60
    for answer in answers:
        np.testing.assert_array_equal(answer.T_w_c, first.T_w_c)
        np.testing.assert_array_equal(answer.covariance, first.covariance)


def test_without_telemetry_the_present_is_constant_velocity(swinging):
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


# -- jitter and drift ----------------------------------------------------------------------------------------------


def jittery(rng, jitter_m, drift, jitter):
    """Error of the position and its stated sigma after four seconds at a known speed with poses that jitter."""
    ekf = BufferedEkf(FusionConfig(sigma_bias_m_s=0.0))
    stamps = 0.1 * np.arange(41)
    seen = 0.3 * stamps + rng.normal(0, jitter_m, len(stamps))
    seen[0] = 0.0
    for k, t in enumerate(stamps):
        velocity = np.array([0.3, 0.0, 0.0]) + rng.normal(0, 0.03, 3)
        ekf.add_telemetry(TelemetrySample(float(t), velocity, np.zeros(3), battery=1.0))
        if k > 0:
            T = np.eye(4)
            T[0, 3] = seen[k] - seen[k - 1]
            ekf.add_relative(float(stamps[k - 1]), float(t), T, drift, jitter)
    state = ekf.state_at(float(stamps[-1]))
    return state.p_w[0] - 0.3 * stamps[-1], np.sqrt(state.covariance[0, 0])


@pytest.mark.slow
def test_jitter_of_visual_poses_is_counted_once(rng):
    """Poses with 1 cm of jitter tell the way to a centimetre however many there are; increments would lose it."""
    once = np.array([jittery(rng, 0.01, PoseSigma(0.0, 1e-4), PoseSigma(0.01, 1e-3)) for _ in range(25)])
    twice = np.array([jittery(rng, 0.01, PoseSigma(0.01 * np.sqrt(2.0), 1e-3), PoseSigma()) for _ in range(25)])
    normalised = float(np.mean((once[:, 0] / once[:, 1]) ** 2))
    assert 0.4 < normalised < 2.0
    assert np.mean(once[:, 1]) < 0.6 * np.mean(twice[:, 1])
    assert np.mean(once[:, 0] ** 2) < np.mean(twice[:, 0] ** 2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2])
def test_the_delay_is_right_whatever_the_phase_of_the_packets(seed):
    """Frames at 20 Hz and state messages at 10 Hz in step: readings interpolated half-way are less noisy, and a search
    that does not know it prefers delays between the steps (0.36 or 0.44 s for 0.40)."""
    t = np.arange(0.0, 20.0, 0.05)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    yaw, pitch = 0.15 * np.sin(0.5 * t), 0.03 * np.sin(0.8 * t)  # gentle: whole degrees hide much of it
    T[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([yaw, pitch, 0.0 * t], axis=1)).as_matrix()
    T[:, :3, 3] = np.stack([0.6 * np.sin(0.6 * t), 0.5 * np.sin(0.45 * t + 1.0), 1.2 + 0.2 * np.sin(0.7 * t)], axis=1)
    T = T @ T_B_C
    faults, rng = TelemetryFaults(video_delay_s=DELAY_S), np.random.default_rng(seed)
    fusion = MotionFusion(FusionConfig(), T_B_C)
    fusion.add_telemetry(simulate(np.random.default_rng(seed), t, T, T_B_C, faults=faults).samples())
    for stamp, pose in zip(t.tolist(), T, strict=True):
        pose[:3, 3] += rng.normal(0.0, 0.001, 3)
        fusion.add_visual(stamp, pose, 0.001, 0.0005)
    assert fusion.delay_s == pytest.approx(DELAY_S, abs=0.025)
    assert abs(fusion.delay_s - DELAY_S) < 3.0 * fusion.flight.delay_sigma_s
