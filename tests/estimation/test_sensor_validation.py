"""Telemetry that is not of this flight, or not of this time, tells no scale and is named."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from swung import T_B_C, at_once, swinging

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.scale.depth_scale import DepthRatio
from edgeslam_torch.estimation.telemetry.sensor_validation import (
    Agreement,
    Reading,
    SensorGate,
    Verdict,
    agreement,
    changes,
)
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate

DEPTH_LOG = 0.1
"""Error of the depth network in these tests."""

# --- the comparison itself -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("found", "verdict"),
    [
        (Agreement(0.99, 5), Verdict.OPEN),
        (Agreement(0.95, 6), Verdict.AGREES),
        (Agreement(0.80, 6), Verdict.OPEN),
        (Agreement(0.70, 40), Verdict.AGREES),
        (Agreement(0.10, 11), Verdict.OPEN),
        (Agreement(0.10, 12), Verdict.CONTRADICTS),
        (Agreement(0.90, 12, dimensions=1), Verdict.OPEN),  # one axis proves less
        (Agreement(0.96, 4, early=True), Verdict.AGREES),
        (Agreement(0.94, 5, early=True), Verdict.OPEN),
        (Agreement(0.99, 3, early=True), Verdict.OPEN),
    ],
)
def test_agreement_and_contradiction_both_need_evidence(found, verdict):
    assert found.verdict is verdict


def test_correlation_needs_no_unit_and_is_that_of_its_definition(rng):
    reported = rng.normal(size=(20, 3))
    seen = reported / 7.0
    found = agreement(seen, reported, 0.0, 0.0)
    assert (found.correlation, found.verdict) == (pytest.approx(1.0), Verdict.AGREES)
    reported[7] = 1000.0  # one wild reading does not decide
    assert agreement(seen, reported, 0.0, 0.0).verdict is Verdict.AGREES
    x, y = np.array([[1.0], [-1.0], [2.0], [-2.0]]), np.array([[1.0], [1.0], [3.0], [-5.0]])
    assert agreement(x, y, 0.0, 0.0).correlation == pytest.approx(16 / math.sqrt(10 * 36))


def test_even_flight_and_hover_prove_nothing_and_a_stand_contradicts(rng):
    straight = np.array([0.3, 0.0, 0.0]) + rng.normal(0, 0.01, (40, 3))
    assert agreement(straight, np.tile([0.5, 0.0, 0.0], (40, 1)), 0.0, 0.06).verdict is Verdict.OPEN
    hover = agreement(rng.normal(0, 0.01, (60, 3)), rng.choice([0.0, 0.05], (60, 3), p=[0.9, 0.1]), 0.1, 0.1)
    assert (hover.count, hover.verdict) == (0, Verdict.OPEN)
    assert agreement(rng.normal(size=(20, 3)), np.zeros((20, 3)), 0.1, 0.06).verdict is Verdict.CONTRADICTS


def test_changes_stay_within_a_segment():
    stamps, segment = np.arange(0.25, 4.0, 0.5), np.repeat([0, 1], 4)
    z = np.array([0.0, 1.0, 2.0, 3.0, 10.0, 10.5, 11.0, 11.5])[:, None]
    np.testing.assert_allclose(np.sort(changes(z, stamps, segment, 0.5).ravel()), [1.0, 1.0, 2.0, 2.0])
    assert changes(z[:0], stamps[:0], segment[:0], 0.5).shape == (0, 1)


def test_a_verdict_is_kept_until_contradicted_and_velocities_rest_on_attitude():
    trust = SensorGate()
    used = []
    for reading, found in [
        (Reading.VELOCITY, Agreement(0.95, 20)),
        (Reading.VELOCITY, Agreement(0.6, 7)),  # a hover
        (Reading.VELOCITY, Agreement(0.1, 20)),
        (Reading.VELOCITY, Agreement(0.95, 20)),
        (Reading.ATTITUDE, Agreement(0.1, 12)),
    ]:
        trust.judge(reading, found)
        used.append(trust.velocity)
        assert trust.velocity == (trust.warnings() == [])
    assert used == [True, True, False, True, False]


# --- flights -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("correlation", [0.3, -0.3])
def test_few_height_changes_count_beside_validated_velocities_unless_they_go_the_other_way(correlation):
    trust = SensorGate()
    trust.judge(Reading.VELOCITY, Agreement(0.95, 20))
    assert trust.height(Reading.BARO), "before any comparison"
    trust.judge(Reading.BARO, Agreement(correlation, 6, dimensions=1))
    assert trust.verdict(Reading.BARO) is Verdict.OPEN
    assert trust.height(Reading.BARO) == (correlation > 0.0)


def smooth(rng, count, size):
    """Velocities of another flight: as slow as a drone's, with no relation to this one."""
    kernel = np.exp(-0.5 * (np.arange(-20, 21) / 6.0) ** 2)
    noise = rng.normal(0, size, (count + 40, 3))
    return np.stack([np.convolve(n, kernel / np.linalg.norm(kernel), "valid") for n in noise.T], axis=1)


def with_velocities(samples, v):
    return [replace(s, velocity_m_s=np.rint(10 * x) / 10) for s, x in zip(samples, v, strict=True)]


def no_heights(samples):
    return [replace(s, tof_m=math.nan, height_m=math.nan, baro_m=math.nan) for s in samples]


def velocities(change):
    """Velocities ``(N, 3)`` changed by a function of the random generator and themselves, without heights."""

    def spoil(rng, samples, motion):
        v = np.array([s.velocity_m_s for s in samples])
        return with_velocities(no_heights(samples), change(rng, v))

    return spoil


def another_flight(rng, samples, motion):
    """All of it: velocities, attitude and heights."""
    T, t = motion.T_w_c.copy(), motion.stamps_s
    T[:, :3, 3] = 0.25 * np.stack([np.sin(1.1 * t + 2.0), np.sin(2.3 * t), np.sin(0.8 * t + 1.0)], axis=1) + [0, 0, 1.2]
    turns = np.stack([0.3 * np.sin(0.43 * t + 1.0), 0.08 * np.sin(1.9 * t), 0.0 * t], axis=1)
    T[:, :3, :3] = Rotation.from_euler("ZYX", turns).as_matrix() @ T_B_C[:3, :3]
    return simulate(rng, t, T, T_B_C).samples()


def column(field, axis, change):
    """Right telemetry but for one column."""

    def spoil(rng, samples, motion):
        values = np.array([getattr(s, field) for s in samples])
        values[:, axis] = change(values[:, axis])
        return [replace(s, **{field: v}) for s, v in zip(samples, values, strict=True)]

    return spoil


def half_way(change):
    return lambda x: np.concatenate([x[: len(x) // 2], change(x[len(x) // 2 :])])


def late_by(seconds):
    return lambda rng, samples, motion: [replace(s, stamp_s=s.stamp_s + seconds) for s in samples]


def right(rng, samples, motion):
    return samples


@pytest.fixture
def told_of(rng):
    """Function that gives the scale without telemetry, the fusion of a flight with spoilt telemetry, and its gauge."""

    def told(motion, spoil, feed=at_once):
        gauge = motion.in_gauge(rng)
        samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=TelemetryFaults()).samples()
        without, fusion = (MotionFusion(FusionConfig(), T_B_C) for _ in range(2))
        for either in (without, fusion):
            for _ in range(20):
                either.metres.add_depth_ratio(DepthRatio(math.log(gauge.scale) + DEPTH_LOG, 0.05))
        feed(fusion, motion, gauge, spoil(rng, samples, motion))
        return without.scale(), fusion, gauge

    return told


@pytest.mark.parametrize(
    "spoil",
    [
        pytest.param(velocities(lambda rng, v: smooth(rng, len(v), 0.3)), id="unrelated"),
        pytest.param(velocities(lambda rng, v: v * [-1, -1, 1]), id="mirrored"),
        pytest.param(velocities(lambda rng, v: 0.0 * v), id="standing"),
        pytest.param(velocities(lambda rng, v: rng.normal(0, 0.3, v.shape)), id="random"),
        pytest.param(velocities(lambda rng, v: 0.0 * v + [0.3, 0.1, 0.0]), id="constant"),
        pytest.param(another_flight, id="another flight"),
    ],
)
def test_velocities_of_no_such_flight_are_not_believed(told_of, spoil):
    without, fusion, _ = told_of(swinging(18.0), spoil)
    scale = fusion.scale()
    assert "telemetry" not in scale.source
    assert scale.sigma / scale.value >= 0.999 * without.sigma / without.value
    assert any("velocities are not used" in w for w in fusion.warnings())
    assert fusion.statistics()["agreement velocities"] < 0.3
    assert fusion.predict(18.1) is None, "nor do they carry the pose on"


@pytest.mark.parametrize("whole", [np.rint, np.trunc])
def test_right_telemetry_is_used_without_a_word(told_of, whole):
    def spoil(rng, samples, motion):
        return [replace(s, velocity_m_s=whole(10 * s.velocity_m_s) / 10) for s in samples]

    without, fusion, gauge = told_of(swinging(18.0), spoil)
    scale = fusion.scale()
    assert "telemetry" in scale.source
    assert scale.sigma / scale.value < 0.5 * without.sigma / without.value
    assert scale.value == pytest.approx(gauge.scale, rel=0.06)
    assert fusion.warnings() == []
    assert min(fusion.statistics()[f"agreement {name}"] for name in ("velocities", "attitude")) > 0.8


@pytest.mark.parametrize(
    ("axis", "change"),
    [
        pytest.param(2, np.zeros_like, id="yaw stuck"),
        pytest.param(2, np.negative, id="yaw mirrored"),
        pytest.param(2, half_way(lambda x: x + math.pi / 2), id="yaw jumping"),
        pytest.param(2, half_way(lambda x: 0.0 * x + x[0]), id="yaw stuck in flight"),
        pytest.param(1, np.negative, id="pitch mirrored"),
        pytest.param(2, lambda x: math.nan * x, id="none"),
    ],
)
def test_attitude_with_one_wrong_column_is_named_and_nothing_rests_on_it(told_of, axis, change):
    without, fusion, _ = told_of(swinging(18.0), column("rpy_rad", axis, change))
    assert fusion.scale() == without
    assert fusion.orientation.upright() is None
    if np.isfinite(change(np.ones(2))).all():
        assert any(("roll", "pitch", "yaw")[axis] in w for w in fusion.warnings())
        fusion.orientation.began_upright = True
        assert not fusion.telemetry().attitude


@pytest.mark.parametrize(
    ("axis", "change"),
    [
        pytest.param(0, np.zeros_like, id="stuck"),
        pytest.param(1, np.negative, id="mirrored"),
        pytest.param(2, half_way(lambda x: x + 1.0), id="jumping"),
    ],
)
def test_velocities_with_one_wrong_column_tell_no_scale(told_of, axis, change):
    def spoil(rng, samples, motion):
        return column("velocity_m_s", axis, change)(rng, no_heights(samples), motion)

    _, fusion, _ = told_of(swinging(18.0), spoil)
    assert "telemetry" not in fusion.scale().source
    assert any("velocities are not used" in w for w in fusion.warnings())


def sideways_late(from_s, end_s):
    """Swung along two axes, along the third only from some time on."""
    motion = swinging(end_s)
    T, later = motion.T_w_c.copy(), np.maximum(motion.stamps_s - from_s, 0.0)
    T[:, 1, 3] = 0.3 * np.sin(1.5 * later)
    return replace(motion, T_w_c=T)


def test_a_column_is_proven_by_motion_along_its_axis(told_of):
    (_, quiet, _), moved = (
        told_of(sideways_late(8.0, end_s), right)[1].telemetry().gain_sigma for end_s in (8.0, 12.0)
    )
    assert quiet > 1.0 > 0.1 > max(moved)


def test_a_sway_below_the_step_of_a_column_does_not_contradict_it(told_of):
    """A drone that flies straight sways by less than 0.1 m/s, which truncation reports as zero."""
    motion = swinging(60.0)
    T, t = motion.T_w_c.copy(), motion.stamps_s
    T[:, 0, 3], T[:, 1, 3] = 1.5 * np.sin(0.3 * t), 0.06 * np.sin(1.4 * t)

    def truncated(rng, samples, motion):
        shown_s = [s.stamp_s + 0.5 for s in samples]
        v = np.stack([np.interp(shown_s, t, axis) for axis in np.gradient(T[:, :3, 3], t, axis=0).T], axis=1)
        assert np.abs(v[:, 1]).max() < 0.1
        return [replace(s, velocity_m_s=np.trunc(10 * x) / 10) for s, x in zip(no_heights(samples), v, strict=True)]

    _, fusion, gauge = told_of(replace(motion, T_w_c=T), truncated)
    assert fusion.warnings() == []
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.06)


@pytest.mark.parametrize(("late_s", "found"), [(0.72, True), (1.2, False), (-2.0, False)])
def test_a_clock_out_of_range_is_reported_with_its_correction(told_of, late_s, found):
    """The video is 0.5 s late: stamps 1.2 s late give a delay of -0.7 s, where -0.2 is the least that is allowed. The
    search has a margin of a step beyond."""
    without, fusion, gauge = told_of(swinging(18.0), late_by(late_s))
    if found:
        assert fusion.delay_s == pytest.approx(0.5 - late_s, abs=0.03)
        assert "telemetry" in fusion.scale().source
        assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.06)
        assert fusion.warnings() == []
        return
    assert fusion.scale().source == "depth"
    assert fusion.scale().sigma == pytest.approx(without.sigma, rel=1e-3)
    (warning,) = fusion.warnings()
    said = re.search(r"stamps are (\d\.\d) s (late|early)", warning)
    assert float(said[1]) == pytest.approx(abs(0.5 - late_s), abs=0.15)
    assert said[2] == ("late" if late_s > 0.5 else "early")


def circling(motion):
    """The same motion of a drone that turns round and round."""
    T = motion.T_w_c.copy()
    T[:, :3, :3] = Rotation.from_euler("z", 0.25 * motion.stamps_s[:, None]).as_matrix() @ T[:, :3, :3]
    return replace(motion, T_w_c=T)


def leaning(motion):
    """The same motion of a body that leans: its nose down."""
    lean = np.eye(4)
    lean[:3, :3] = Rotation.from_euler("y", 0.4).as_matrix()
    return replace(motion, T_w_c=motion.T_w_c @ np.linalg.inv(T_B_C) @ lean @ T_B_C)


def in_axes_of(rotation):
    """Velocities rotated by a function of roll, pitch and yaw, as whole dm/s."""
    return lambda rng, samples, motion: with_velocities(
        no_heights(samples), [rotation(s.rpy_rad).apply(s.velocity_m_s) for s in samples]
    )


@pytest.mark.parametrize(
    ("change", "rotation", "frame"),
    [
        (circling, lambda rpy: Rotation.from_euler("z", -rpy[2]), "in body axes"),
        (circling, lambda rpy: Rotation.from_euler("z", rpy[2]), "without the turn by yaw"),
        (leaning, lambda rpy: Rotation.from_euler("ZYX", rpy[::-1]).inv(), "body axes, its lean included"),
        (circling, lambda rpy: Rotation.identity(), None),
        (leaning, lambda rpy: Rotation.identity(), None),
    ],
    ids=["body", "turned back", "leaning body", "right, turning", "right, leaning"],
)
def test_images_have_the_last_word_on_the_velocities_frame(told_of, change, rotation, frame):
    """Also of a camera in a hand, which looks down and hardly turns: its velocities fit by more than 80 % as they are.
    What the filter gets is turned as well: it carries the pose on."""
    motion = change(swinging(20.0))
    _, fusion, gauge = told_of(motion, in_axes_of(rotation))
    assert fusion.scale().source == "telemetry+depth"
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.06)
    assert [frame in w for w in fusion.warnings()] == [True] * (frame is not None)


@pytest.mark.parametrize(
    ("factor", "heights", "source"), [(10.0, True, "height+depth"), (10.0, False, "none"), (0.5, True, None)]
)
def test_velocities_in_the_wrong_unit_are_named_and_the_scale_covers_them(told_of, factor, heights, source):
    """The depth network confirms the heights. Beside the network alone one of both is wrong, and nothing says which."""

    def spoil(rng, samples, motion):
        samples = samples if heights else no_heights(samples)
        return [replace(s, velocity_m_s=factor * s.velocity_m_s) for s in samples]

    _, fusion, gauge = told_of(swinging(18.0, size_m=0.5), spoil)
    scale = fusion.scale()
    assert source in (scale.source, None)
    assert abs(math.log(scale.value / gauge.scale)) < 2.0 * scale.sigma / scale.value
    assert any("contradict each other" in w for w in fusion.warnings())
    if source == "height+depth":
        model = fusion.telemetry()
        assert (model.velocity, model.height) == (False, "tof"), "nor do they pull at the map in its refinement"


@pytest.mark.parametrize("change", [lambda z: 1.0 + 0.0 * z, lambda z: 3.0 - z], ids=["stuck", "mirrored"])
def test_heights_that_do_not_climb_with_the_images_are_not_used(told_of, change):
    def spoil(rng, samples, motion):
        z = [change(s.tof_m) for s in samples]
        return [replace(s, tof_m=x, height_m=x, baro_m=x) for s, x in zip(samples, z, strict=True)]

    _, fusion, gauge = told_of(swinging(18.0, size_m=0.5), spoil)
    assert "height" not in fusion.scale().source
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.06)  # the velocities are right
    assert any("height (tof) is not used" in w for w in fusion.warnings())


# --- what constrains the map --------------------------------------------------------------------------------------


def test_gravity_constrains_an_upright_map_before_the_scale_is_known():
    fusion = MotionFusion(FusionConfig(), T_B_C)
    assert fusion.telemetry() is None, "nothing says where up is"
    fusion.orientation.began_upright = True
    model = fusion.telemetry()
    assert model.attitude and (model.velocity, model.height) == (False, None)
    assert (model.R_w_m == np.eye(3)).all()
