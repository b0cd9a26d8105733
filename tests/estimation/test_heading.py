"""What a drone's attitude says of a camera's headings, against flights whose truth is known."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from swung import T_B_C, swinging

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.estimation.sensors.attitude import turned as between
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.noise import HEADING_DRIFT_RAD_S, HEADING_RAD, TURN_SHARE
from edgeslam_torch.synthetic.flights.telemetry import EXACT, simulate


def flown(rng, motion, keep=lambda sample: True, turn=0.0, spoil=lambda sample: sample, **changes):
    """Headings of some frames, and their true rotations, in a map that is turned about the vertical."""
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=EXACT).samples()
    track = TelemetryTrack("world", 0.35)
    track.add([spoil(sample) for sample in samples if keep(sample)])
    R_m_w = Rotation.from_euler("z", turn).as_matrix()
    chosen = np.arange(20, len(motion.stamps_s) - 20, 15)
    model = TelemetryModel(track, FusionConfig(), T_B_C, R_m_w.T, 0.0, 0.0, 1.0, 0.02, True, None, truncates=0.0)
    yaw = Rotation.from_matrix(motion.T_w_c[0, :3, :3] @ T_B_C[:3, :3].T).as_euler("ZYX")[0]
    R_w_c = Rotation.from_euler("z", -yaw).as_matrix() @ motion.T_w_c[chosen, :3, :3]
    told = replace(model, **changes).headings(motion.stamps_s[chosen])
    return told, np.swapaxes(R_m_w @ R_w_c, 1, 2), motion.stamps_s[chosen]


def chi2(told, error):
    return float(error @ told.information @ error)


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_they_are_the_cameras(rng, turn):
    told, true, _ = flown(rng, swinging(14.0), turn=turn)
    off = Rotation.from_matrix(np.swapaxes(told.R_c_m, 1, 2) @ true[told.frame]).magnitude()
    assert np.degrees(off).max() < 0.1
    np.testing.assert_allclose(told.up_m, [0.0, 0.0, 1.0], atol=1e-12)


def test_a_common_turn_costs_nothing_and_one_keyframe_alone_its_sigma(rng):
    told, _, stamps_s = flown(rng, swinging(14.0))
    n = len(told.frame)
    common, alone = np.full(n, math.radians(3.0)), np.zeros(n)
    alone[n // 2] = HEADING_RAD
    assert chi2(told, common) < 0.02
    assert chi2(told, alone) == pytest.approx(1.0, rel=0.3)
    step = np.where(np.arange(n) < n // 2, 0.0, 2.0 * HEADING_RAD)
    drift = HEADING_DRIFT_RAD_S * (stamps_s - stamps_s[0])
    assert chi2(told, step) > 10.0
    assert chi2(told, drift) < 1.1


def test_half_a_percent_of_each_turn_costs_little(rng):
    """As a focal length that is half a percent off turns a camera, and not by twice as much one way as the other."""
    motion = swinging(14.0)
    stamps_s = flown(rng, motion)[2]
    yaw = 20.0 * 0.3 * np.sin(0.7 * stamps_s)  # twenty times what is swung: whole turns
    wide = replace(motion, T_w_c=turned(motion, 20.0))
    told = flown(rng, wide)[0]
    assert chi2(told, TURN_SHARE * yaw) < 1.5
    assert chi2(told, TURN_SHARE * np.abs(yaw)) > 10.0


def turned(motion, share):
    """Poses of a camera that swings its heading so many times as wide."""
    yaw = (share - 1.0) * 0.3 * np.sin(0.7 * motion.stamps_s)
    T_w_c = motion.T_w_c.copy()
    T_w_c[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix() @ T_w_c[:, :3, :3]
    return T_w_c


def test_nothing_is_told_without_attitude_or_metres_or_in_a_hole(rng):
    motion = swinging(14.0)
    assert flown(rng, motion, attitude=False)[0] is None
    assert flown(rng, motion, scale_sigma_log=np.inf)[0] is None
    told, true, stamps_s = flown(rng, motion, keep=lambda sample: not 4.0 < sample.stamp_s < 8.0)
    missing = (stamps_s > 4.1) & (stamps_s < 7.9)
    assert missing.any() and not np.isin(np.flatnonzero(missing), told.frame).any()


def test_headings_after_a_jump_of_yaw_do_not_pass(rng):
    """A map that turns by five degrees on the way is one that headings are to correct."""

    def jumps(sample):
        return replace(sample, rpy_rad=sample.rpy_rad + [0.0, 0.0, math.radians(30.0) * (sample.stamp_s > 7.0)])

    told, true, _ = flown(rng, swinging(14.0), turn=2.0)
    bend = Rotation.from_euler("z", np.radians(np.linspace(0.0, 5.0, len(told.frame)))[:, None]).as_matrix()
    assert told.passes(true[told.frame])
    assert told.passes(true[told.frame] @ bend)
    told, true, _ = flown(rng, swinging(14.0), turn=2.0, spoil=jumps)
    assert not told.passes(true[told.frame])


def test_attitude_turns_the_camera_between_two_frames_but_not_across_a_gap(rng):
    motion = swinging(14.0)
    track = TelemetryTrack("world", 0.35)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=EXACT).samples()
    track.add([s for s in samples if not 8.0 < s.stamp_s < 9.0])
    for i, j in ((60, 62), (100, 130)):
        R_c1_c0 = between(track, *motion.stamps_s[[i, j]], T_B_C[:3, :3])
        true = motion.T_w_c[j, :3, :3].T @ motion.T_w_c[i, :3, :3]
        assert np.degrees(Rotation.from_matrix(R_c1_c0.T @ true).magnitude()) < 0.3
    assert between(track, 7.9, 9.1, T_B_C[:3, :3]) is None
    assert between(track, 13.9, 14.5, T_B_C[:3, :3]) is None, "no reading yet"
