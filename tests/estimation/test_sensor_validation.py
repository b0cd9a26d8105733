"""Telemetry that is not of this flight, or not of this time, tells no scale and is named."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.estimation.scale.belief import ScaleBelief
from edgeslam_torch.estimation.scale.camera_mount import Turned
from edgeslam_torch.estimation.scale.depth_scale import DepthRatio
from edgeslam_torch.estimation.telemetry.sensor_validation import (
    Agreement,
    Reading,
    SensorGate,
    Verdict,
    agreement,
    changes,
)
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate

T_B_C = camera_on_body()
DEPTH_LOG = 0.1
"""Error of the depth network in these tests."""


# --- the comparison itself -----------------------------------------------------------------------------------------


def test_the_same_motion_in_other_units_agrees_in_full(rng):
    told = rng.normal(size=(20, 3))
    found = agreement(told / 7.0, told, 0.0, 0.0)
    assert found.correlation == pytest.approx(1.0)
    assert (found.share, found.verdict) == (pytest.approx(1.0), Verdict.AGREES)


def test_correlation_of_small_numbers_by_hand():
    seen, told = np.array([[1.0], [-1.0], [2.0], [-2.0]]), np.array([[1.0], [1.0], [3.0], [-5.0]])
    assert agreement(seen, told, 0.0, 0.0).correlation == pytest.approx(16 / math.sqrt(10 * 36))


def test_agreement_and_contradiction_both_need_evidence():
    assert Agreement(0.99, 5).verdict is Verdict.OPEN
    assert Agreement(0.95, 6).verdict is Verdict.AGREES
    assert Agreement(0.80, 6).verdict is Verdict.OPEN
    assert Agreement(0.70, 40).verdict is Verdict.AGREES
    assert Agreement(0.10, 11).verdict is Verdict.OPEN
    assert Agreement(0.10, 12).verdict is Verdict.CONTRADICTS
    assert Agreement(0.90, 12, dimensions=1).verdict is Verdict.OPEN  # one axis proves less


def test_few_intervals_validate_velocities_only_at_high_correlation():
    assert Agreement(0.96, 4, early=True).verdict is Verdict.AGREES
    assert Agreement(0.94, 5, early=True).verdict is Verdict.OPEN
    assert Agreement(0.99, 3, early=True).verdict is Verdict.OPEN
    assert Agreement(0.92, 6, early=True).verdict is Verdict.AGREES


def test_an_even_flight_proves_nothing_either_way(rng):
    """Straight on at one speed: what noise does about the mean must not count against it."""
    seen = np.array([0.3, 0.0, 0.0]) + rng.normal(0, 0.01, (40, 3))
    found = agreement(seen, np.tile([0.5, 0.0, 0.0], (40, 1)), 0.0, 0.06)
    assert found.verdict is Verdict.OPEN


def test_standing_still_while_the_images_move_contradicts(rng):
    found = agreement(rng.normal(size=(20, 3)), np.zeros((20, 3)), 0.1, 0.06)
    assert found.correlation == 0.0
    assert found.verdict is Verdict.CONTRADICTS


def test_hovering_says_nothing(rng):
    found = agreement(rng.normal(0, 0.01, (60, 3)), rng.choice([0.0, 0.05], (60, 3), p=[0.9, 0.1]), 0.1, 0.1)
    assert found.count == 0
    assert found.verdict is Verdict.OPEN


def test_one_wild_reading_does_not_decide(rng):
    told = rng.normal(size=(30, 3))
    seen = told.copy()
    told[7] = 1000.0
    assert agreement(seen, told, 0.0, 0.0).verdict is Verdict.AGREES


def test_changes_stay_within_a_segment():
    stamps = np.arange(0.25, 4.0, 0.5)
    segment = np.array([0, 0, 0, 0, 1, 1, 1, 1])
    z = np.array([0.0, 1.0, 2.0, 3.0, 10.0, 10.5, 11.0, 11.5])[:, None]
    np.testing.assert_allclose(np.sort(changes(z, stamps, segment, 0.5).ravel()), [1.0, 1.0, 2.0, 2.0])
    assert changes(z[:0], stamps[:0], segment[:0], 0.5).shape == (0, 1)


def test_verdict_is_kept_until_contradicted():
    trust = SensorGate()
    assert not trust.velocity
    trust.judge(Reading.VELOCITY, Agreement(0.95, 20))
    trust.judge(Reading.VELOCITY, Agreement(0.6, 7))  # a hover
    assert trust.velocity
    trust.judge(Reading.VELOCITY, Agreement(0.1, 20))
    assert not trust.velocity


# --- flights -------------------------------------------------------------------------------------------------------


def smooth(rng, count, size):
    """Velocities of another flight: as slow as a drone's, with no relation to this one."""
    kernel = np.exp(-0.5 * (np.arange(-20, 21) / 6.0) ** 2)
    noise = rng.normal(0, size, (count + 40, 3))
    return np.stack([np.convolve(n, kernel / np.linalg.norm(kernel), "valid") for n in noise.T], axis=1)


def with_velocities(samples, v):
    return [replace(s, velocity_m_s=np.rint(10 * x) / 10) for s, x in zip(samples, v, strict=True)]


def no_heights(samples):
    return [replace(s, tof_m=math.nan, height_m=math.nan, baro_m=math.nan) for s in samples]


def white(rng, samples, motion):
    return with_velocities(no_heights(samples), rng.normal(0, 0.3, (len(samples), 3)))


def unrelated(rng, samples, motion):
    return with_velocities(no_heights(samples), smooth(rng, len(samples), 0.3))


def another_flight(rng, samples, motion):
    """All of it: velocities, attitude and heights."""
    T, t = motion.T_w_c.copy(), motion.stamps_s
    T[:, :3, 3] = 0.25 * np.stack([np.sin(1.1 * t + 2.0), np.sin(2.3 * t), np.sin(0.8 * t + 1.0)], axis=1) + [0, 0, 1.2]
    turns = np.stack([0.3 * np.sin(0.43 * t + 1.0), 0.08 * np.sin(1.9 * t), 0.0 * t], axis=1)
    T[:, :3, :3] = Rotation.from_euler("ZYX", turns).as_matrix() @ T_B_C[:3, :3]
    return simulate(rng, t, T, T_B_C).samples()


def mirrored(rng, samples, motion):
    """y to the right taken for y to the left, and x backwards."""
    return with_velocities(no_heights(samples), [s.velocity_m_s * [-1, -1, 1] for s in samples])


def standing(rng, samples, motion):
    return with_velocities(no_heights(samples), np.zeros((len(samples), 3)))


def constant(rng, samples, motion):
    return with_velocities(no_heights(samples), np.tile([0.3, 0.1, 0.0], (len(samples), 1)))


def told_of(rng, replay, motion, spoil, **options):
    """Scale without telemetry, fusion with it, and the true scale."""
    gauge = motion.in_gauge(rng)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=TelemetryFaults()).samples()
    without, fusion = (MotionFusion(FusionConfig(), T_B_C) for _ in range(2))
    for either in (without, fusion):
        for _ in range(20):
            either.metres.add_depth_ratio(DepthRatio(math.log(gauge.scale) + DEPTH_LOG, 0.05))
    replay(fusion, motion, gauge, spoil(rng, samples, motion), **options)
    return without.scale(), fusion, gauge


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "spoil", [unrelated, mirrored, *(pytest.param(s, marks=SLOW) for s in (standing, white, another_flight, constant))]
)
def test_velocities_of_no_such_flight_are_not_believed(rng, swinging, replay, spoil):
    without, fusion, _ = told_of(rng, replay, swinging(18.0), spoil)
    scale = fusion.scale()
    assert "telemetry" not in scale.source
    assert scale.sigma / scale.value >= 0.999 * without.sigma / without.value
    assert any("velocities are not used" in w for w in fusion.warnings())
    assert fusion.statistics()["agreement velocities"] < 0.3


@pytest.mark.parametrize("truncated", [False, pytest.param(True, marks=SLOW)])
def test_right_telemetry_is_used_without_a_word(rng, swinging, replay, truncated):
    def spoil(rng, samples, motion):
        whole = np.trunc if truncated else np.rint
        return [replace(s, velocity_m_s=whole(10 * s.velocity_m_s) / 10) for s in samples]

    without, fusion, gauge = told_of(rng, replay, swinging(18.0), spoil)
    scale = fusion.scale()
    assert "telemetry" in scale.source
    assert scale.sigma / scale.value < 0.5 * without.sigma / without.value
    assert scale.value == pytest.approx(gauge.scale, rel=0.06)
    assert fusion.warnings() == []
    assert fusion.statistics()["agreement velocities"] > 0.8
    assert fusion.statistics()["agreement attitude"] > 0.8


def test_attitude_of_another_flight_is_named_and_takes_the_heights_with_it(rng, swinging, replay):
    def spoil(rng, samples, motion):
        turns = smooth(rng, len(samples), 0.2)
        return [replace(s, rpy_rad=s.rpy_rad * 0.0 + x) for s, x in zip(samples, turns, strict=True)]

    _, fusion, _ = told_of(rng, replay, swinging(18.0), spoil)
    assert "height" not in fusion.scale().source
    assert any("attitude" in w for w in fusion.warnings())
    fusion.orientation.began_upright = True
    assert not fusion.telemetry().attitude


def column(field, axis, change):
    """Right telemetry but for one column."""

    def spoil(rng, samples, motion):
        values = np.array([getattr(s, field) for s in samples])
        values[:, axis] = change(values[:, axis])
        return [replace(s, **{field: v}) for s, v in zip(samples, values, strict=True)]

    return spoil


def half_way(change):
    return lambda x: np.concatenate([x[: len(x) // 2], change(x[len(x) // 2 :])])


@pytest.mark.parametrize(
    ("axis", "change"),
    [
        pytest.param(2, np.zeros_like, marks=SLOW),
        pytest.param(2, np.negative, marks=SLOW),
        pytest.param(2, half_way(lambda x: x + math.pi / 2), marks=SLOW),
        (2, half_way(lambda x: 0.0 * x + x[0])),
        pytest.param(1, np.negative, marks=SLOW),
    ],
    ids=["yaw stuck", "yaw mirrored", "yaw jumping", "yaw stuck in flight", "pitch mirrored"],
)
def test_attitude_with_one_wrong_column_is_named_and_nothing_rests_on_it(rng, swinging, replay, axis, change):
    without, fusion, _ = told_of(rng, replay, swinging(18.0), column("rpy_rad", axis, change))
    assert fusion.scale() == without
    assert fusion.orientation.upright() is None
    assert any(("roll", "pitch", "yaw")[axis] in w for w in fusion.warnings())


def test_telemetry_without_attitude_is_as_good_as_none(rng, swinging, replay):
    without, fusion, _ = told_of(rng, replay, swinging(18.0), column("rpy_rad", 2, lambda x: math.nan * x))
    assert fusion.scale() == without
    assert fusion.orientation.upright() is None


@pytest.mark.parametrize(
    ("axis", "change"),
    [
        pytest.param(0, np.zeros_like, id="stuck"),
        pytest.param(1, np.negative, marks=SLOW, id="mirrored"),
        pytest.param(2, half_way(lambda x: x + 1.0), id="jumping"),
    ],
)
def test_velocities_with_one_wrong_column_tell_no_scale(rng, swinging, replay, axis, change):
    def spoil(rng, samples, motion):
        return column("velocity_m_s", axis, change)(rng, no_heights(samples), motion)

    _, fusion, _ = told_of(rng, replay, swinging(18.0), spoil)
    assert "telemetry" not in fusion.scale().source
    assert any("velocities are not used" in w for w in fusion.warnings())


def sideways_late(swinging, from_s):
    """Swung along two axes, along the third only from some time on."""
    motion = swinging(from_s + 4.0)
    T, later = motion.T_w_c.copy(), np.maximum(motion.stamps_s - from_s, 0.0)
    T[:, 1, 3] = 0.3 * np.sin(1.5 * later)
    return replace(motion, T_w_c=T)


def until(motion, end_s):
    keep = motion.stamps_s < end_s
    return replace(motion, stamps_s=motion.stamps_s[keep], T_w_c=motion.T_w_c[keep])


def test_motion_along_one_axis_proves_nothing_of_another(rng, swinging, replay):
    """Velocities that agree so far do not pull the map along an axis that has not moved yet."""
    motion = sideways_late(swinging, 8.0)
    gauge = motion.in_gauge(rng)
    samples = simulate(rng, motion.stamps_s, motion.T_w_c, T_B_C, faults=TelemetryFaults()).samples()
    fusion = MotionFusion(FusionConfig(), T_B_C)
    replay(fusion, until(motion, 8.3), gauge, column("velocity_m_s", 1, np.negative)(rng, samples, motion))
    asked = (motion.stamps_s > 7.9) & (motion.stamps_s < 8.75)
    p = gauge.T_m_c[asked][::4, :3, 3]
    reported = fusion.telemetry().positions(motion.stamps_s[asked][::4], p)
    assert fusion.telemetry().velocity
    chi2 = p.ravel() @ reported.information @ p.ravel() - 2 * reported.vector @ p.ravel() + reported.constant
    assert chi2 < 4.0 * reported.rows


def test_a_column_is_proven_by_motion_along_its_axis(rng, swinging, replay):
    motion = sideways_late(swinging, 8.0)
    fusions = []
    for end_s in (8.0, 12.0):
        _, fusion, gauge = told_of(rng, replay, until(motion, end_s), lambda rng, samples, motion: samples)
        fusions.append(fusion.telemetry().gain_sigma)
        assert abs(math.log(fusion.scale().value / gauge.scale)) < 3.0 * fusion.scale().sigma / fusion.scale().value
    (_, quiet, _), moved = fusions
    assert quiet > 1.0 > 0.1 > max(moved)


def test_velocities_and_heights_that_contradict_each_other_are_not_surer_than_they_are_apart(rng, swinging, replay):
    def halved(rng, samples, motion):
        return [replace(s, velocity_m_s=0.5 * s.velocity_m_s) for s in samples]

    _, fusion, gauge = told_of(rng, replay, swinging(18.0, size_m=0.5), halved)
    scale = fusion.scale()
    assert abs(math.log(scale.value / gauge.scale)) < 2.0 * scale.sigma / scale.value


@pytest.mark.parametrize("late_s", [1.2, pytest.param(-2.0, marks=SLOW)])
def test_a_wrong_clock_is_reported_with_its_correction(rng, swinging, replay, late_s):
    """The video itself is 0.5 s late: stamps 1.2 s late give a delay of -0.7 s, outside the search range."""

    def spoil(rng, samples, motion):
        return [replace(s, stamp_s=s.stamp_s + late_s) for s in samples]

    without, fusion, _ = told_of(rng, replay, swinging(18.0), spoil)
    scale = fusion.scale()
    assert scale.source == "depth"
    assert scale.sigma == pytest.approx(without.sigma, rel=1e-3)
    (warning,) = fusion.warnings()
    delay_s = float(warning.split("stamps are ")[1].split(" s ")[0])
    assert delay_s == pytest.approx(abs(0.5 - late_s), abs=0.15)
    assert ("late" if late_s > 0.5 else "early") in warning


def circling(swinging):
    """A drone that swings and turns round and round."""
    motion = swinging(20.0)
    R = Rotation.from_euler("z", 0.25 * motion.stamps_s[:, None]).as_matrix()
    T = motion.T_w_c.copy()
    T[:, :3, :3] = R @ T[:, :3, :3]
    return replace(motion, T_w_c=T)


def turned_by_yaw(samples, times):
    """Velocities in other axes, as whole dm/s."""
    return with_velocities(
        samples, [Rotation.from_euler("z", times * s.rpy_rad[2]).apply(s.velocity_m_s) for s in samples]
    )


@pytest.mark.parametrize(
    ("times", "frame"), [(-1, "in body axes"), pytest.param(1, "without the turn by yaw", marks=SLOW)]
)
def test_images_have_the_last_word_on_the_velocities_frame(rng, swinging, replay, times, frame):
    """Undeclared body axes; world axes that the log's reader mistook for body axes and rotated.

    What filter and prediction get is turned as well: it carries the pose on.
    """
    motion = circling(swinging)

    def spoil(rng, samples, motion):
        return turned_by_yaw(no_heights(samples), times)

    _, fusion, gauge = told_of(rng, replay, motion, spoil, tracked=lambda t: t < 18.0)
    scale = fusion.scale()
    assert scale.source == "telemetry+depth"
    assert scale.value == pytest.approx(gauge.scale, rel=0.06)
    (warning,) = fusion.warnings()
    assert frame in warning
    told = fusion.predict(19.0)
    moved_m = gauge.scale * np.linalg.norm(told.T_w_c[:3, 3] - gauge.T_m_c[motion.stamps_s.searchsorted(19.0), :3, 3])
    assert moved_m < 0.1


def leaning(motion, lean_rad):
    """The same motion of a body that leans: its nose down."""
    lean = np.eye(4)
    lean[:3, :3] = Rotation.from_euler("y", lean_rad).as_matrix()
    return replace(motion, T_w_c=motion.T_w_c @ np.linalg.inv(T_B_C) @ lean @ T_B_C)


def test_velocities_in_the_axes_of_a_leaning_body_are_recognised_although_they_fit_well(rng, swinging, replay):
    """A camera in a hand looks down and hardly turns: such velocities go with the images to more than 80 %."""

    def spoil(rng, samples, motion):
        return with_velocities(
            no_heights(samples),
            [Rotation.from_euler("ZYX", s.rpy_rad[::-1]).inv().apply(s.velocity_m_s) for s in samples],
        )

    _, fusion, gauge = told_of(rng, replay, leaning(swinging(20.0), 0.4), spoil)
    scale = fusion.scale()
    assert scale.source == "telemetry+depth"
    assert scale.value == pytest.approx(gauge.scale, rel=0.03)
    (warning,) = fusion.warnings()
    assert "body axes, its lean included" in warning
    before = float(re.search(r"(\d+) % before", warning).group(1))
    assert before > 80.0


@SLOW
def test_right_velocities_of_a_leaning_body_stay_as_they_are(rng, swinging, replay):
    motion = leaning(swinging(20.0), 0.4)
    _, fusion, gauge = told_of(rng, replay, motion, lambda rng, samples, motion: no_heights(samples))
    assert fusion.warnings() == []
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.03)


@SLOW
def test_right_velocities_of_a_turning_drone_stay_as_they_are(rng, swinging, replay):
    _, fusion, gauge = told_of(rng, replay, circling(swinging), lambda rng, samples, motion: samples)
    assert fusion.warnings() == []
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.06)


def test_velocities_are_unused_if_their_attitude_contradicts_the_images():
    trust = SensorGate()
    trust.judge(Reading.VELOCITY, Agreement(0.95, 12))
    assert trust.velocity
    trust.judge(Reading.ATTITUDE, Agreement(0.1, 12))
    assert not trust.velocity
    assert any("velocities are not used" in w for w in trust.warnings())


def test_validated_velocities_without_a_scale_are_reported():
    trust = SensorGate()
    trust.judge(Reading.VELOCITY, Agreement(0.8, 12))
    assert trust.warnings() == []
    trust.tells_scale = False
    assert any("too badly to determine a scale" in w for w in trust.warnings())


def test_velocities_in_the_wrong_unit_are_named_and_dropped(rng, swinging, replay):
    """The depth network confirms the heights: what remains is no surer than heights without any velocities."""
    motion = swinging(18.0, size_m=0.5)

    def spoil(rng, samples, motion):
        return [replace(s, velocity_m_s=10.0 * s.velocity_m_s) for s in samples]

    def white_velocities(rng, samples, motion):
        return with_velocities(samples, rng.normal(0, 0.3, (len(samples), 3)))

    _, fusion, gauge = told_of(np.random.default_rng(1), replay, motion, spoil)
    _, heights, _ = told_of(np.random.default_rng(1), replay, motion, white_velocities)
    scale = fusion.scale()
    assert scale.source == heights.scale().source == "height+depth"
    assert scale.sigma >= 0.9 * heights.scale().sigma
    assert abs(scale.value - gauge.scale) < 2 * scale.sigma
    (warning,) = (w for w in fusion.warnings() if "contradict each other" in w)
    assert warning.endswith("not used: telemetry's velocities")
    model = fusion.telemetry()
    assert (model.velocity, model.height) == (False, "tof"), "nor do they pull at the map in its refinement"


@pytest.mark.parametrize(
    ("beliefs", "speaks"),
    [
        ({"telemetry": (1.0, 0.35), "height": (1.0, 0.35)}, True),
        ({"height": (1.0, 0.1)}, True),
        ({"height": (1.0, 0.28)}, False),
        ({"telemetry": (10.0, 0.1), "height": (1.0, 0.1), "depth": (1.0, 0.15)}, False),
        ({"telemetry": (10.0, 0.1), "height": (1.0, 0.1)}, False),
    ],
)
def test_velocities_constrain_the_map_only_with_a_consistent_scale(beliefs, speaks):
    """A young map's heights may tell a unit several times off at a quarter, and velocities would tear it by that."""
    fusion = MotionFusion(FusionConfig(), T_B_C)
    fusion.orientation.found = Turned(np.eye(3), np.eye(3), np.zeros(3))
    fusion.orientation.began_upright = True
    trust = fusion.flight.trust
    trust.judge(Reading.VELOCITY, Agreement(0.99, 30))
    found = {name: ScaleBelief(math.log(value), sigma, name) for name, (value, sigma) in beliefs.items()}
    for _ in range(100 if found.pop("depth", None) else 0):
        fusion.metres.add_depth_ratio(DepthRatio(0.0, 0.05))
    fusion.metres.take(found, None, trust)
    assert fusion.telemetry().velocity is speaks


def test_gravity_constrains_an_upright_map_before_the_scale_is_known():
    fusion = MotionFusion(FusionConfig(), T_B_C)
    assert fusion.telemetry() is None, "nothing says where up is"
    fusion.orientation.began_upright = True
    model = fusion.telemetry()
    assert model.attitude and (model.velocity, model.height) == (False, None)
    assert (model.R_w_m == np.eye(3)).all()


def test_velocities_in_the_wrong_unit_with_nothing_beside_them_give_no_metres(rng, swinging, replay):
    """Only the depth network contradicts them: one of the two is wrong, and the data do not say which."""

    def spoil(rng, samples, motion):
        return [replace(s, velocity_m_s=10.0 * s.velocity_m_s) for s in no_heights(samples)]

    _, fusion, _ = told_of(rng, replay, swinging(18.0), spoil)
    assert not math.isfinite(fusion.scale().sigma)
    assert any("right unit" in w for w in fusion.warnings())


@pytest.mark.parametrize(
    ("late_s", "found"),
    [(0.72, True), pytest.param(0.83, False, marks=SLOW)],
)
def test_a_delay_at_the_end_of_the_range_is_found_and_one_beyond_it_is_said(rng, swinging, replay, late_s, found):
    """Delays of -0.18 to -0.4 s where -0.2 is the least that is allowed; the search has a margin of a step beyond."""

    def spoil(rng, samples, motion):
        return [replace(s, stamp_s=s.stamp_s + late_s) for s in samples]

    _, fusion, gauge = told_of(rng, replay, swinging(18.0), spoil)
    assert ("telemetry" in fusion.scale().source) == found
    if found:
        assert fusion.delay_s == pytest.approx(0.5 - late_s, abs=0.03)
        assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.06)
        assert fusion.warnings() == []
    else:
        (warning,) = fusion.warnings()
        said = re.search(r"telemetry is not used: it fits the images if its stamps are (0\.\d) s late", warning)
        assert said is not None
        assert float(said[1]) == pytest.approx(late_s - 0.5, abs=0.06), "searched in steps of 0.1 s"


@pytest.mark.parametrize("how", [pytest.param("random", marks=SLOW), "stuck"])
def test_heights_that_do_not_climb_with_the_images_are_not_used(rng, swinging, replay, how):
    def spoil(rng, samples, motion):
        z = rng.uniform(0.3, 2.0, len(samples)) if how == "random" else np.full(len(samples), 1.0)
        return [replace(s, tof_m=x, height_m=x, baro_m=x) for s, x in zip(samples, z.tolist(), strict=True)]

    _, fusion, gauge = told_of(rng, replay, swinging(18.0, size_m=0.5), spoil)
    scale = fusion.scale()
    assert "height" not in scale.source
    assert scale.value == pytest.approx(gauge.scale, rel=0.06)  # the velocities are right
    assert any("height (tof) is not used" in w for w in fusion.warnings())


def test_telemetry_that_froze_is_named(rng, swinging, replay):
    def spoil(rng, samples, motion):
        last = next(s for s in samples if s.stamp_s > 9.0 and np.abs(s.velocity_m_s).max() > 0.15)
        return [s if s.stamp_s < 9.0 else replace(last, stamp_s=s.stamp_s) for s in samples]

    _, fusion, gauge = told_of(rng, replay, swinging(18.0), spoil)
    assert fusion.scale().value == pytest.approx(gauge.scale, rel=0.06)
    (warning,) = fusion.warnings()
    assert "repeats one message" in warning
    seconds = float(warning.split("for ")[1].split(" s")[0])
    assert seconds == pytest.approx(8.5, abs=0.5)


@SLOW
def test_lies_that_begin_in_flight_take_the_scale_back(rng, swinging, replay):
    """Right for a while, then of another flight for three times as long: what was believed is dropped."""

    def spoil(rng, samples, motion):
        lies = smooth(rng, len(samples), 0.4)
        spoilt = with_velocities(no_heights(samples), lies)
        return [s if s.stamp_s < 8.0 else t for s, t in zip(no_heights(samples), spoilt, strict=True)]

    without, fusion, _ = told_of(rng, replay, swinging(32.0), spoil)
    scale = fusion.scale()
    assert "telemetry" not in scale.source
    assert scale.sigma == pytest.approx(without.sigma, rel=1e-3)


def test_implausible_telemetry_does_not_carry_the_pose_on(rng, swinging, replay):
    _, fusion, _ = told_of(rng, replay, swinging(14.5), white, tracked=lambda t: t < 14.0)
    assert fusion.predict(14.5) is None
