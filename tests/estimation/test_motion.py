"""Scale, vertical and delay of flights whose truth is known."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from swung import T_B_C, at_once, replay, swinging

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.scale.belief import ScaleBelief
from edgeslam_torch.estimation.scale.depth_scale import DepthRatio, compared
from edgeslam_torch.estimation.scale_estimator import ScaleEstimator
from edgeslam_torch.estimation.telemetry_scale import TelemetryFit
from edgeslam_torch.geometry import se3
from edgeslam_torch.noise import DEPTH_SCALE_LOG
from edgeslam_torch.synthetic.flights.telemetry import EXACT, TelemetryFaults, simulate
from edgeslam_torch.types import ScaleEstimate, Units

AT_ONCE = TelemetryFaults(video_delay_s=0.0)


@pytest.fixture
def fused(rng):
    """Function that gives the fusion of a flight with simulated telemetry, and the map's gauge."""

    def run(motion, faults=None, config=None, feed=at_once, change=lambda sample: sample, network=None, seed=None):
        dice = rng if seed is None else np.random.default_rng(seed)
        samples = simulate(dice, motion.stamps_s, motion.T_w_c, T_B_C, faults=faults or TelemetryFaults()).samples()
        gauge = motion.in_gauge(dice)
        fusion = MotionFusion(config or FusionConfig(), T_B_C)
        for _ in range(50 if network else 0):
            fusion.metres.add_depth_ratio(DepthRatio(math.log(network * gauge.scale), 0.05))
        feed(fusion, motion, gauge, [change(s) for s in samples])
        return fusion, gauge

    return run


def without_heights(sample):
    return replace(sample, tof_m=math.nan, height_m=math.nan, baro_m=math.nan)


def z_of(scale, gauge):
    """Error of a scale in its own sigmas."""
    return math.log(scale.value / gauge.scale) * scale.value / scale.sigma


def test_a_swung_camera_in_flight(fused):
    """Scale, vertical, delay and the filter's way, frame by frame."""
    motion, states = swinging(), []

    def feed(fusion, *given):
        def each(t, i):
            if 10.0 < t < 19.4 and i % 10 == 0:
                ekf = fusion.snapshot().filter.ekf
                states.append((ekf.stamp_s, ekf.state_at(ekf.stamp_s).p_w))

        replay(fusion, *given, each=each)

    fusion, gauge = fused(motion, feed=feed)
    scale = fusion.scale()
    assert scale.value == pytest.approx(gauge.scale, rel=0.03)
    assert abs(z_of(scale, gauge)) < 3.0
    assert scale.units is Units.METRES and "telemetry" in scale.source
    assert fusion.delay_s == pytest.approx(0.5, abs=0.04)
    up = gauge.T_m_w[:3, :3] @ [0.0, 0.0, 1.0]
    assert math.degrees(math.acos(min(1.0, float(up @ fusion.orientation.R_w_m[2])))) < 0.5
    body = (motion.T_w_c @ se3.inverse(T_B_C))[:, :3, 3]
    truth = np.array([body[round((stamp_s + 0.5) * 20)] for stamp_s, _ in states])
    moved = np.array([p_w for _, p_w in states])
    off = (moved - moved[0]) - (truth - truth[0])
    assert np.sqrt(np.mean(np.sum(off**2, axis=1))) < 0.1
    told = fusion.statistics()
    assert told["ekf visual accepted"] > 100
    assert told.get("ekf visual refused", 0) < 0.1 * told["ekf visual accepted"], "95 % pass"


def test_gravity_is_there_with_the_first_frame(rng):
    motion = swinging(3.0)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=EXACT).samples()
    fusion = MotionFusion(FusionConfig(delay_s=0.0), T_B_C)
    fusion.add_telemetry(samples[:2])
    fusion.add_visual(0.05, motion.T_w_c[1], 0.003, 0.002)
    np.testing.assert_allclose(fusion.orientation.R_w_m[2], [0.0, 0.0, 1.0], atol=0.02)


# --- a climb ------------------------------------------------------------------------------------------------------


def take_off(motion, t):
    """A drone that climbs by 0.8 m in 1.6 s and then flies ahead."""
    z = 0.4 + 0.8 * np.clip((t - 0.4) / 1.6, 0.0, 1.0)
    x = 0.3 * np.clip(t - 2.0, 0.0, None) ** 1.2
    smooth = np.ones(9) / 9.0
    p = np.stack([np.convolve(np.pad(a, 4, "edge"), smooth, "valid") for a in (x, 0.0 * t, z)], axis=1)
    T_w_c = np.tile(T_B_C, (len(t), 1, 1))
    T_w_c[:, :3, 3] += p
    return replace(motion, stamps_s=t, T_w_c=T_w_c)


def test_climb_gives_the_scale_within_its_sigma(fused):
    """After four half seconds."""
    motion = take_off(swinging(1.0), np.arange(0.0, 3.0, 0.05))
    for seed in range(2):
        found = []

        def feed(fusion, *given, found=found):
            replay(fusion, *given, each=lambda stamp_s, _: found.append((stamp_s, fusion.scale())))

        _, gauge = fused(motion, TelemetryFaults(video_delay_s=0.5), feed=feed, seed=seed)
        at_s, scale = next(told for told in found if told[1].sigma < 0.1 * told[1].value)
        assert at_s < 2.8
        assert abs(z_of(scale, gauge)) < 2.5


def on_the_spot(motion, t, z, yaw):
    """A drone that rises to heights ``(N,)`` and turns by ``(N,)``."""
    T_w_b = np.tile(np.eye(4), (len(t), 1, 1))
    T_w_b[:, :3, :3] = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    T_w_b[:, 2, 3] = z
    return replace(motion, stamps_s=t, T_w_c=T_w_b @ T_B_C)


@pytest.mark.parametrize("ranged", [True, False])
def test_a_creeping_climb_without_images_is_seen_by_the_range_sensor(fused, ranged):
    """Four centimetres a second are zero in whole decimetres."""
    motion, found = swinging(18.0), []
    blind_s = np.clip(motion.stamps_s - 12.0, 0.0, None)
    T_w_c = np.where(blind_s[:, None, None] > 0.0, motion.T_w_c[240], motion.T_w_c)
    T_w_c[:, 2, 3] += 0.04 * blind_s
    faults = TelemetryFaults(video_delay_s=0.0, velocity_noise_m_s=0.0, velocity_walk=0.0)

    def feed(fusion, *given):
        def each(t, i):
            found.extend([fusion.predict(t).T_w_c[:3, 3]] if t > 13.0 else [])

        replay(fusion, *given, tracked=lambda t: t <= 12.0, each=each)

    change = (lambda sample: sample) if ranged else without_heights
    _, gauge = fused(replace(motion, T_w_c=T_w_c), faults, feed=feed, change=change)
    risen = gauge.scale * float(gauge.T_m_w[:3, 2] @ (found[-1] - found[0]))
    assert risen == pytest.approx(0.2 if ranged else 0.0, abs=0.04)


def test_height_changes_alone_tell_the_scale_of_a_climb(fused):
    t = np.arange(0.0, 20.0, 0.05)
    fusion, gauge = fused(on_the_spot(swinging(1.0), t, 1.0 + 0.5 * np.sin(0.6 * t), 0.0 * t))
    assert "height" in fusion.scale().source
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.04)


def test_pure_rotation_discards_the_scale_of_a_climb(fused):
    """A quarter of a metre up in seven seconds, of which velocities tell nothing; then round on the spot: the map in
    view shares nothing any more with what the climb told. A drone that glances to the side keeps them."""
    t, told = np.arange(0.0, 14.0, 0.1), {}
    risen = np.clip(t / 7.0, 0, 1)
    for turned_rad in (0.0, 0.5, 1.5, 3.0):
        yaw = 0.2 * np.sin(t) + turned_rad * np.clip((t - 7.0) / 5.0, 0, 1)
        motion = on_the_spot(swinging(1.0), t, 0.4 + 0.25 * risen**2 * (3 - 2 * risen), yaw)
        told[turned_rad] = fused(motion, AT_ONCE, network=1.5, seed=0)[0].metres.sensor_scale
    assert told[0.0].source == "height" and told[0.0].sigma < 0.13
    assert told[0.5].sigma < 1.1 * told[0.0].sigma < told[1.5].sigma < told[3.0].sigma
    assert told[3.0].sigma > 0.2, "two views beyond the overlap, each of a unit that is .15 another"


def test_small_height_changes_give_no_scale(fused):
    """A drone that hovers and glances about, and rises by 15 cm in ten seconds: so sensors and maps drift."""
    t = np.arange(0.0, 12.0, 0.05)
    motion = on_the_spot(swinging(1.0), t, 1.0 + 0.015 * t, 0.2 * np.sin(t))
    for seed in range(3):
        assert fused(motion, AT_ONCE, network=1.5, seed=seed)[0].metres.sensor_scale is None


# --- drift and hover ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("sources", "held"), [(["height"], False), (["telemetry", "height"], True)])
@pytest.mark.parametrize("found", [None, {}, {"height": ScaleBelief(0.1, 0.4, "height")}])
def test_a_scale_is_held_in_hover_unless_it_is_from_heights_alone(sources, held, found):
    trusting = SimpleNamespace(velocity=True, tells_scale=True, height=lambda reading: True)
    metres = ScaleEstimator(FusionConfig(), 0.0)
    metres.take({source: ScaleBelief(0.0, 0.1, source) for source in sources}, TelemetryFit(), trusting)
    metres.take(found, None, trusting)
    assert (metres.sensor_scale is not None) == (held and found is None)


@pytest.mark.parametrize("common", [0.0, 0.1])
def test_noise_in_common_does_not_explain_that_velocities_and_heights_disagree(common):
    """By two sigmas of their difference: their mean has half of it as its sigma, beside what they share."""
    metres, own, off = ScaleEstimator(FusionConfig(), 0.0), 0.03, 0.06 * math.sqrt(2.0)
    trusting = SimpleNamespace(velocity=True, tells_scale=True, height=lambda reading: True)
    told = {"telemetry": ScaleBelief(0.0, own, "telemetry"), "height": ScaleBelief(off, own, "height")}
    metres.take(told, TelemetryFit(noise_log=common), trusting)
    assert metres.scale().sigma / metres.scale().value == pytest.approx(math.hypot(off / 2.0, common), rel=0.01)


@pytest.mark.parametrize(
    ("source", "sigma", "path_ratio", "used"),
    [
        ("telemetry", 0.25, 100.0, True),
        ("height", 0.1, 1.3, True),
        ("height", 0.1, None, False),
        ("height", 0.25, 1.3, False),
        ("height", 0.1, 3.28, False),  # in feet
        ("height", 0.1, 0.1, False),
    ],
)
def test_velocities_are_used_only_at_a_scale_that_they_agree_with(source, sigma, path_ratio, used):
    trusting = SimpleNamespace(velocity=True, tells_scale=True, height=lambda reading: True)
    metres = ScaleEstimator(FusionConfig(), 0.0)
    metres.take({source: ScaleBelief(0.0, sigma, source)}, TelemetryFit(path_ratio=path_ratio), trusting)
    assert metres.uses_velocity(trusting) == used
    assert not metres.uses_velocity(SimpleNamespace(velocity=False))


# --- the depth network and an earlier flight ----------------------------------------------------------------------


def by_network(focal_sigma=0.0, **ratio):
    fusion = MotionFusion(FusionConfig(), T_B_C, focal_sigma)
    for _ in range(50):
        fusion.metres.add_depth_ratio(DepthRatio(math.log(3.0), **({"spread_log": 0.05} | ratio)))
    return fusion


def test_depth_network_alone_gives_a_scale_until_an_earlier_flight_knows_better():
    fusion = by_network()
    own = fusion.scale()
    assert (own.source, own.units, own.value) == ("depth", Units.METRES, pytest.approx(3.0))
    assert DEPTH_SCALE_LOG < own.sigma / own.value < 0.2
    fusion.metres.remember(ScaleEstimate(1.0, 0.03, "telemetry"))
    assert fusion.scale() == ScaleEstimate(1.0, pytest.approx(0.03), "atlas")
    for unknown in (ScaleEstimate(), None):
        fusion.metres.remember(unknown)
        assert fusion.scale() == own


def test_network_out_of_domain_gives_no_scale_and_a_warning():
    fusion = by_network(spread_log=0.3, slope=0.0)
    assert fusion.scale().units is Units.ARBITRARY
    (warning,) = fusion.warnings()
    assert "out of its domain" in warning and "finetune" in warning


def test_the_networks_unit_is_what_it_told_of_the_map(rng):
    fusion = MotionFusion(FusionConfig(), T_B_C)
    assert fusion.metres.network_unit() is None
    depth = rng.uniform(1.0, 4.0, 50)
    for _ in range(5):
        fusion.metres.add_depth_ratio(compared(0.6 * depth, depth))
    assert fusion.metres.network_unit() == pytest.approx(0.6)


def test_an_uncertain_focal_length_widens_all_scales_and_telemetry_least(rng):
    motion = swinging(20.0)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=EXACT).samples()
    gauge, scales = motion.in_gauge(rng), []
    for focal_sigma in (0.0, 0.45):
        fusion = MotionFusion(FusionConfig(), T_B_C, focal_sigma)
        at_once(fusion, motion, gauge, samples)
        scales.append(fusion.scale())
    known, unsure = scales
    assert unsure.value == pytest.approx(known.value)
    assert known.sigma / known.value < 0.05 < 0.1 < unsure.sigma / unsure.value < 0.45
    network = by_network(focal_sigma=0.45).scale()
    assert 0.45 < network.sigma / network.value < 0.5


# --- faults -------------------------------------------------------------------------------------------------------


def test_a_frozen_or_silent_link_does_not_pull_the_scale(rng):
    motion = swinging(20.0)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C).samples()
    gauge, scales = motion.in_gauge(rng), []
    last = next(s for s in samples if s.stamp_s > 8.0 and np.abs(s.velocity_m_s).max() > 0.15)
    frozen = [replace(last, stamp_s=s.stamp_s) if 8.0 < s.stamp_s < 15.0 else s for s in samples]
    for log in (frozen, [s for s in samples if not 8.0 < s.stamp_s < 15.0]):
        fusion = MotionFusion(FusionConfig(), T_B_C)
        at_once(fusion, motion, gauge, log)
        scales.append(fusion.scale().value)
    assert scales == pytest.approx([gauge.scale] * 2, rel=0.03)
    assert scales[0] == pytest.approx(scales[1], rel=0.003)  # a repeated height says nothing, like a repeated velocity


def test_lost_frames_and_poses_that_are_no_number_are_no_evidence(fused):
    def feed(fusion, motion, gauge, samples):
        gauge.T_m_c[200:300, :3, 3] *= 3.0  # what a lost tracker may report
        gauge.T_m_c[100:110, 0, 3] = np.nan
        replay(fusion, motion, gauge, samples, tracked=lambda t: not 10.0 <= t < 15.0)

    fusion, gauge = fused(swinging(20.0), feed=feed)
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.04)
    assert np.isfinite(fusion.predict(20.1).T_w_c).all()
    assert fusion.statistics()["visual not tracked"] == 110


# --- rounding -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size_m", [0.13, 0.25])
@pytest.mark.parametrize("whole", [np.trunc, np.rint])
@pytest.mark.parametrize("heights", [False, True])
def test_the_images_tell_rounding_from_truncation(rng, fused, whole, size_m, heights):
    """Read wrongly the scale is 15 to 25 % off; in the smaller swing no velocity reaches three steps, so that readings
    alone tell nothing."""

    def change(s):
        s = replace(s, velocity_m_s=whole(10 * (s.velocity_m_s + rng.normal(0, 0.02, 3))) / 10)
        return s if heights else without_heights(s)

    fusion, gauge = fused(swinging(20.0, size_m=size_m), replace(EXACT, video_delay_s=0.5), change=change)
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.06)
    assert abs(z_of(fusion.scale(), gauge)) < 2.0
    assert fusion.scale().sigma < (0.05 if heights else 0.2) * gauge.scale


def test_velocities_and_heights_that_disagree_widen_sigma(rng):
    """Heights 15 % too large: neither is nonsense, and the scale may be that of either."""
    motion, stated = swinging(20.0), []
    gauge = motion.in_gauge(rng)
    for factor in (1.0, 1.15):
        exact = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=EXACT, floor_m=0.0).samples()
        told = [replace(s, tof_m=factor * s.tof_m, height_m=factor * s.height_m, baro_m=np.nan) for s in exact]
        fusion = MotionFusion(FusionConfig(delay_s=0.0), T_B_C)
        at_once(fusion, motion, gauge, told)
        assert fusion.scale().source == "telemetry+height"
        stated.append(fusion.scale().sigma / fusion.scale().value)
    assert stated[0] < 0.02 < 0.3 * math.log(1.15) < stated[1]


@pytest.mark.data
def test_a_real_tello_truncates_its_velocities(data_dir):
    from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
    from edgeslam_torch.readers.telemetry_csv import read_telemetry

    track = TelemetryTrack("world", 0.35)
    track.add(read_telemetry(data_dir / "tello_telemetry" / "flight_b.csv")[0])
    assert track.truncation_log_odds(0.1) > 5.0
