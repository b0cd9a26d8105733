"""Where telemetry carries a pose on while no filter does, and how late the video is."""

from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.prediction import TelemetryPropagation
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.estimation.telemetry.visual_memory import VisualPose
from edgeslam_torch.estimation.telemetry_scale import TelemetryFit
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import EXACT, TelemetryFaults, simulate
from edgeslam_torch.types import ScaleEstimate

T_B_C = camera_on_body()
DELAY_S = 0.5


@pytest.mark.parametrize("gap_s", [0.4, 0.8])
def test_exact_telemetry_carries_the_camera_to_where_it_is(rng, swinging, gap_s):
    """The video is half a second late; the map is the drone's world, halved."""
    motion = swinging(12.0)
    track = TelemetryTrack("world", 0.5)
    track.add(simulate(rng, motion.stamps_s + DELAY_S, motion.T_w_c, T_B_C, faults=EXACT).samples())
    errors, still = [], []
    for i in range(100, 180, 7):
        now = i + round(gap_s * 20)
        T = motion.T_w_c.copy()
        T[:, :3, 3] *= 0.5
        last = VisualPose(motion.stamps_s[i] + 2 * DELAY_S, T[i], 1e-3, 1e-3)
        carried = TelemetryPropagation(
            track, DELAY_S, 0.0, T_B_C, np.eye(3), ScaleEstimate(2.0, 0.02, "known"), TelemetryFit()
        )
        found = carried.on(last, motion.stamps_s[now] + 2 * DELAY_S)
        errors.append(np.linalg.norm(found.T_w_c[:3, 3] - T[now, :3, 3]))
        still.append(np.linalg.norm(T[i, :3, 3] - T[now, :3, 3]))
        assert np.linalg.norm(se3.log(se3.inverse(T[now]) @ found.T_w_c)[3:]) < 0.02
    assert np.mean(errors) < 0.1 * np.mean(still)


@pytest.mark.parametrize("seed", [0, 1])
def test_noisy_attitude_gives_the_delay_for_any_packet_phase(swinging, replay, seed):
    """Half a degree of noise: an attitude between two packets has less, which must not draw the delay to it."""
    rng = np.random.default_rng(seed)
    motion = swinging(20.0)
    told = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=TelemetryFaults(video_delay_s=0.4)).samples()
    noisy = [replace(sample, rpy_rad=sample.rpy_rad + rng.normal(0.0, 0.01, 3)) for sample in told]
    fusion = MotionFusion(FusionConfig(), T_B_C)
    replay(fusion, motion, motion.in_gauge(rng), noisy)
    assert fusion.delay_s == pytest.approx(0.4, abs=0.008)


def test_a_turn_is_as_sure_as_the_delay_is_known(rng, swinging):
    """A guess that is a third of a second off, at turns that go to and fro: three sigmas cover what comes of it."""
    motion, wrong_s = swinging(12.0), 0.3
    track = TelemetryTrack("world", 0.5)
    track.add(simulate(rng, motion.stamps_s + DELAY_S, motion.T_w_c, T_B_C, faults=EXACT).samples())
    off, sigma = [], []
    for i in range(100, 180, 7):
        now, T = i + 16, motion.T_w_c
        last = VisualPose(motion.stamps_s[i] + 2 * DELAY_S, T[i], 1e-3, 1e-3)
        known = ScaleEstimate(1.0, 0.02, "known")
        carried = TelemetryPropagation(track, DELAY_S - wrong_s, np.inf, T_B_C, np.eye(3), known, TelemetryFit())
        found = carried.on(last, motion.stamps_s[now] + 2 * DELAY_S)
        off.append(np.linalg.norm(se3.log(se3.inverse(T[now]) @ found.T_w_c)[3:]))
        sigma.append(found.sigma_r_rad)
    off, sigma = np.array(off), np.array(sigma)
    assert off.max() > 3 * 0.012, "more than three sigmas of whole degrees and a drift"
    assert (off < 3.0 * sigma).all()
    assert np.median(off / sigma) > 0.5, "no more doubt than there is"
