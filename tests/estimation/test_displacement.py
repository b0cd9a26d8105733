"""What telemetry says of camera positions, against flights whose truth is known."""

from dataclasses import replace

import numpy as np
import pytest
from swung import T_B_C, swinging

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.synthetic.flights.telemetry import EXACT, TelemetryFaults, simulate
from edgeslam_torch.types import TelemetrySample


def model_of(samples, R_w_m=None, scale=1.0, **changes):
    track = TelemetryTrack("world", 0.35)
    track.add(samples)
    R = np.eye(3) if R_w_m is None else R_w_m
    model = TelemetryModel(track, FusionConfig(), T_B_C, R, 0.0, 0.0, scale, 0.02, True, None, truncates=0.0)
    return replace(model, **changes)


@pytest.mark.parametrize("rate_rad_s", [2.0, 4.0])
def test_readings_that_are_means_over_a_tenth_of_a_second_give_back_the_way(rate_rad_s):
    """A swing of 10 cm: what the mean takes away, and what the trapezoid rule does, is put back."""
    t = np.arange(0.0, 8.0, 0.1)
    position = np.sin(rate_rad_s * np.stack([t - 0.05, t + 0.05])) / 10.0
    track = TelemetryTrack("world", 0.35)
    velocity = (position[1] - position[0]) / 0.1
    track.add([TelemetrySample(s, np.array([v, 0.0, 0.0]), np.zeros(3)) for s, v in zip(t, velocity, strict=True)])
    asked = np.arange(0.5, 7.0, 0.1)
    moved = track.displacement(asked)[:, 0]
    true = np.sin(rate_rad_s * asked) / 10.0
    slope = np.polyfit(true, moved, 1)[0]
    assert slope == pytest.approx(1.0, abs=0.001)


def power_on_axes(motion):
    """Rotation of the simulated world to the drone's power-on axes."""
    forward = (motion.T_w_c[0, :3, :3] @ T_B_C[:3, :3].T)[:, 0]
    yaw = np.arctan2(forward[1], forward[0])
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def flown(rng, motion, faults=EXACT, every=12, **changes):
    """Model, stamps and true positions of some keyframes of a flight, all in power-on axes."""
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=faults, floor_m=0.0).samples()
    chosen = np.arange(30, len(motion.stamps_s) - 30, every)
    p = motion.T_w_c[chosen, :3, 3] @ power_on_axes(motion).T
    return model_of(samples, **changes), motion.stamps_s[chosen], p


def chi2(told, p):
    x = p.ravel()
    return float(x @ told.information @ x - 2 * told.vector @ x + told.constant)


def best(told, p):
    """Positions of least cost, as near to ``p`` as that leaves open."""
    slope = told.vector - told.information @ p.ravel()
    return p + (np.linalg.pinv(told.information, rcond=1e-10) @ slope).reshape(-1, 3)


@pytest.mark.parametrize("height", [None, "tof"])
def test_right_positions_cost_next_to_nothing_and_wrong_ones_are_mended(rng, height):
    model, stamps, p = flown(rng, swinging(12.0), height=height, scale_sigma_log=0.02)
    right = model.positions(stamps, p)
    assert chi2(right, p) < 0.02 * right.rows
    disturbed = p + rng.normal(0.0, 0.01, p.shape)
    told = model.positions(stamps, disturbed)
    assert chi2(told, disturbed) > 10.0 * chi2(told, p)
    short = np.diff(best(told, disturbed), axis=0) - np.diff(p, axis=0)
    assert np.abs(short).max() < 0.01


def test_a_map_whose_scale_drifts_is_straightened_without_knowing_the_scale(rng):
    model, stamps, p = flown(rng, swinging(20.0))
    growth = np.linspace(1.0, 1.4, len(p) - 1)[:, None]
    drifted = np.vstack([p[:1], p[0] + np.cumsum(growth * np.diff(p, axis=0), axis=0)])
    told = model.positions(stamps, drifted, 1.0)
    mended = np.diff(best(told, drifted), axis=0)
    ratio = np.linalg.norm(mended, axis=1) / np.linalg.norm(np.diff(p, axis=0), axis=1)
    third = len(ratio) // 3
    assert np.median(ratio[-third:]) / np.median(ratio[:third]) == pytest.approx(1.0, abs=0.02)


def test_gauge_of_the_map_does_not_matter(rng):
    """The same flight in a turned, shifted map of other units."""
    model, stamps, p = flown(rng, swinging(12.0), height="tof")
    c, s = np.cos(0.7), np.sin(0.7)
    R_w_m = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])
    elsewhere = replace(model, R_w_m=R_w_m, scale=2.5)
    wrong = p + rng.normal(0.0, 0.02, p.shape)
    in_map = wrong @ R_w_m / 2.5 + [1.0, 2.0, 3.0]
    here, there = model.positions(stamps, wrong), elsewhere.positions(stamps, in_map)
    shifted = chi2(there, in_map - [1.0, 2.0, 3.0])
    assert shifted == pytest.approx(chi2(here, wrong), rel=1e-6)


@pytest.mark.parametrize("height", [None, "tof"])
def test_velocities_that_jump_bend_no_map(rng, height):
    """One metre a second too much from the middle on: the map's own shape stays, and the first half is used."""
    motion = swinging(12.0)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=EXACT).samples()
    wrong = [replace(s, velocity_m_s=s.velocity_m_s + [s.stamp_s > 6.0, 0.0, 0.0]) for s in samples]
    _, stamps, p = flown(rng, motion)
    told = replace(model_of(wrong), height=height).positions(stamps, p)
    late = np.sum(stamps > 6.5)
    assert late - 2 <= told.refused <= late + 2
    assert chi2(told, p) < 0.1 * told.rows
    early = stamps < 5.5
    stretched = p + np.where(early, 0.3, 0.0)[:, None] * (p - p[0])
    assert chi2(told, stretched) > 10.0 * told.rows


def test_a_motion_after_a_hover_corrects_a_map_on_guessed_depths_that_saw_nothing_of_it(rng):
    motion = swinging(16.0)
    T = motion.T_w_c.copy()
    T[:, :3, 3] = T[0, :3, 3] + np.clip(motion.stamps_s - 12.0, 0.0, None)[:, None] * [0.4, 0.0, 0.0]
    model, stamps, p = flown(rng, replace(motion, T_w_c=T))
    still = np.tile(p[:1], (len(p), 1))
    told = model.positions(stamps, still, guessed=stamps > 12.0)
    assert told.refused == 0
    np.testing.assert_allclose(best(told, still) - best(told, still)[0], p - p[0], atol=0.03)
    assert model.positions(stamps, still).refused > 0, "a map of triangulated points is believed"


def test_an_outage_leaves_the_positions_across_it_alone(rng):
    motion = swinging(20.0)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=EXACT).samples()
    kept = [s for s in samples if not 8.0 < s.stamp_s < 10.0]
    _, stamps, p = flown(rng, motion)
    told = model_of(kept).positions(stamps, p)
    apart = p + np.where(stamps > 9.0, 1.0, 0.0)[:, None]
    assert chi2(told, apart) == pytest.approx(chi2(told, p), abs=1e-6)


@pytest.mark.parametrize("truncated", [False, True])
def test_chi_square_of_the_truth_is_what_it_should_be(truncated):
    """Twenty draws of a Tello's telemetry: the covariance is neither too small nor much too large."""
    motion, values = swinging(15.0), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        faults = replace(EXACT, velocity_noise_m_s=0.03, velocity_walk=0.003, quantise=not truncated)
        model, stamps, p = flown(rng, motion, faults)
        if truncated:
            rng = np.random.default_rng(seed)
            samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=faults, floor_m=0.0).samples()
            cut = [replace(s, velocity_m_s=np.trunc(s.velocity_m_s / 0.1) * 0.1) for s in samples]
            model = model_of(cut, truncates=1.0)
        told = model.positions(stamps, p)
        values.append(chi2(told, p) / (3 * told.rows))
    assert 0.3 < np.mean(values) < 1.2


def test_gravity_points_up(rng):
    motion = swinging(12.0)
    model, stamps, _ = flown(rng, motion, faults=replace(EXACT, quantise=True))
    up = model.up(stamps)
    chosen = np.searchsorted(motion.stamps_s, stamps[up.frame])
    true = motion.T_w_c[chosen, 2, :3]
    assert np.degrees(np.arccos(np.sum(up.up_c * true, axis=1).clip(-1, 1))).max() < 1.5
    np.testing.assert_allclose(up.up_m, [0.0, 0.0, 1.0])


def leaning(pitch_deg, **changes):
    """Model of a drone with these pitches, ten a second."""
    rpy = np.radians([[0.0, float(pitch), 0.0] for pitch in pitch_deg])
    return model_of([TelemetrySample(0.1 * k, np.zeros(3), a) for k, a in enumerate(rpy)], **changes)


def test_strong_lean_gives_no_vertical_before_the_scale_is_known():
    """A drone that takes off leans by some degrees. A map of a camera that only turns has no parallax to tell a lean of
    half a degree from motion: held by attitude its depths run away."""
    for lean_deg, told in ((6.0, True), (20.0, False)):
        model = leaning(np.where(np.arange(100) < 50, 0.0, lean_deg), scale_sigma_log=np.inf)
        assert (model.up(np.array([3.0])) is not None) is told
        assert np.degrees(model.up(np.array([1.0])).sigma_rad) == pytest.approx(2.0)
        assert replace(model, scale_sigma_log=0.1).up(np.array([3.0])) is not None


def test_silence_says_nothing(rng):
    model, stamps, p = flown(rng, swinging(6.0))
    assert model.positions(stamps[:1], p[:1]) is None
    assert replace(model, velocity=False).positions(stamps, p) is None
    assert model.positions(stamps + 100.0, p) is None
    assert model.up(stamps + 100.0) is None
    level = [TelemetrySample(0.1 * k, np.zeros(3), np.full(3, np.nan)) for k in range(50)]
    assert model_of(level).up(stamps) is None


def test_a_late_video_is_taken_into_account(rng):
    motion = swinging(12.0)
    faults = replace(EXACT, video_delay_s=0.5)
    model, stamps, p = flown(rng, motion, faults, delay_s=0.5)
    early = replace(model, delay_s=0.3)
    right, wrong = model.positions(stamps, p), early.positions(stamps, p)
    assert chi2(right, p) < 0.02 * right.rows
    assert chi2(wrong, p) > 20.0 * chi2(right, p)
    unsure = replace(early, delay_sigma_s=0.2).positions(stamps, p)
    assert chi2(unsure, p) < 0.3 * chi2(wrong, p)
    assert TelemetryFaults().video_delay_s == 0.5


@pytest.mark.parametrize(("way_s", "least_m", "most_m"), [(0.5, 0.0145, 0.02), (8.0, 0.15, 0.2)])
def test_a_drone_whose_reading_stays_the_same_does_not_fly_evenly(way_s, least_m, most_m):
    """Half a second errs by the rounding as it is, .0145 m; eight would by .23, were it the same all the while."""
    samples = [
        TelemetrySample(t, np.array([0.3, 0.0, 0.0]), np.array([0.0, 0.0, 1e-3 * t])) for t in np.arange(0.0, 12.0, 0.1)
    ]
    stamps = np.array([1.0, 1.0 + way_s])
    p = np.array([[0.0, 0.0, 0.0], [0.3 * way_s, 0.0, 0.0]])
    told = model_of(samples, scale_sigma_log=1e-6).positions(stamps, p)
    assert least_m < told.information[3, 3] ** -0.5 < most_m
