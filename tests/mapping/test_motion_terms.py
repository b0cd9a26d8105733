"""Telemetry in a window: a part of the map that hangs on nothing else keeps scale and place."""

import math
from dataclasses import replace
from functools import reduce

import numpy as np
import pytest
from point_map import CAMERA, check_map, filled
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from edgeslam_torch.config import MappingConfig, SlamConfig, WindowConfig
from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.map.keyframe import NO_ANCHOR
from edgeslam_torch.map.revisit import MIN_SHARED, is_back
from edgeslam_torch.mapping.last_refinement import lm_config
from edgeslam_torch.mapping.mapper import Mapper
from edgeslam_torch.mapping.motion_terms import EFFECTIVE_SAMPLES, motion_factors, vertical_since
from edgeslam_torch.mapping.refinement import (
    Window,
    recent_map,
    refine,
    whole_map,
    window_problem,
)
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.synthetic.flights.telemetry import EXACT, simulate
from edgeslam_torch.types import TelemetrySample

T_B_C = camera_on_body()


@pytest.fixture
def halves(rng):
    """Six keyframes, one a second: the first three share no anchor with the last three."""
    points = filled(rng, 400, 6)
    points.part(lambda number: number >= 3)
    return points


def telemetry_of(rng, points, scale=1.0):
    """The model of a drone that flew by all keyframes in their order, in a map of other units."""
    T_w_c = se3.inverse(points.world.T_c_w)
    stamps = np.array([k.stamp_s for k in points.keyframes])
    t = np.arange(-1.0, stamps[-1] + 1.0, 0.05)
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, :3, 3] = scale * CubicSpline(stamps, T_w_c[:, :3, 3])(t)
    T[:, :3, :3] = Slerp(stamps, Rotation.from_matrix(T_w_c[:, :3, :3]))(t.clip(stamps[0], stamps[-1])).as_matrix()
    track = TelemetryTrack("world", 0.35)
    track.add(simulate(rng, t, T, T_B_C, faults=EXACT).samples())
    yaw = Rotation.from_matrix(T[0, :3, :3] @ T_B_C[:3, :3].T).as_euler("ZYX")[0]
    R_w_m = Rotation.from_euler("z", -yaw).as_matrix()
    return TelemetryModel(track, FusionConfig(), T_B_C, R_w_m, 0.0, 0.0, scale, 0.01, True, None, truncates=0.0)


def blow_up(points, factor, first=3):
    """The keyframes from one on and their anchors, scaled about the one before it."""
    centre = points.keyframes[first - 1].centre_w
    for keyframe in points.keyframes[first:]:
        T_w_c = keyframe.T_w_c
        T_w_c[:3, 3] = centre + factor * (T_w_c[:3, 3] - centre)
        keyframe.T_c_w = se3.inverse(T_w_c)
    mine = points.map.anchors_seen_by(points.keyframes[first:])
    points.map.anchors.p_w[mine] = centre + factor * (points.map.anchors.p_w[mine] - centre)


def far(points):
    true = se3.inverse(points.world.T_c_w)[3:, :3, 3]
    return max(float(np.linalg.norm(k.centre_w - c)) for k, c in zip(points.keyframes[3:], true, strict=True))


@pytest.mark.parametrize("factor", [0.7, 1.4])
@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_scale_is_preserved_without_shared_anchors(rng, halves, factor, scale):
    blow_up(halves, factor)
    off = far(halves)
    window = Window(halves.keyframes[3:], halves.keyframes[:3], halves.map.anchors_seen_by(halves.keyframes))
    refine(halves.map, window, CAMERA, LmConfig())
    assert far(halves) > 0.9 * off
    refine(halves.map, window, CAMERA, LmConfig(max_iterations=50), telemetry_of(rng, halves, scale))
    assert far(halves) < 0.05 * off
    check_map(halves.map)


def test_the_recent_map_corrects_a_drift_that_a_window_preserves(rng, halves):
    blow_up(halves, 1.4)
    window = recent_map(halves.map, halves.keyframes[-1], 60)
    assert ([k.id for k in window.free], [k.id for k in window.fixed]) == ([1, 2, 3, 4, 5], [0])
    refine(halves.map, window, CAMERA, lm_config(WindowConfig()), telemetry_of(rng, halves))
    ratio = spread_of(halves, 3, 6) / spread_of(halves, 0, 3)
    true = se3.inverse(halves.world.T_c_w)[:, :3, 3]
    # One distance keeps the unit, so that the model's line through the bent way leaves a sixth of the drift at once.
    assert ratio == pytest.approx(np.ptp(true[3:], axis=0).max() / np.ptp(true[:3], axis=0).max(), rel=0.08)
    check_map(halves.map)


@pytest.fixture
def there_and_back(rng):
    """Twelve keyframes: the first and the last four see the same half of the room, those between the other half."""
    points = filled(rng, 600, 12)
    points.part(lambda number: 4 <= number < 8)
    return points


def back(keyframes, earlier, last, reach=0.0):
    """`is_back` of the first ``last`` keyframes, the first ``earlier`` of which are not recent."""
    return is_back(keyframes[:earlier], keyframes[earlier:last], np.full(last, reach))


def test_a_revisit_follows_a_loss_of_view(there_and_back):
    keyframes = there_and_back.keyframes
    assert back(keyframes, 6, 12)
    assert back(keyframes, 6, 9)
    assert not back(keyframes, 6, 8), "what it sees has been in view all the time"
    assert not back(keyframes, 2, 4)
    assert not is_back(keyframes[:2], keyframes[9:], np.zeros(5)), "nothing between tells that it was out of view"
    assert is_back(keyframes[:9], keyframes[9:], np.zeros(12)), "it came back before the recent ones, and stayed"
    for keyframe in keyframes[8:]:
        held = np.flatnonzero(keyframe.anchor >= 0)
        there_and_back.map.forget_observations(keyframe, held[MIN_SHARED - 1 :])
    assert not back(keyframes, 6, 12), "too few anchors in common"


def test_a_rotation_is_no_revisit(there_and_back):
    keyframes = there_and_back.keyframes
    way = max(np.linalg.norm(keyframes[8].centre_w - k.centre_w) for k in keyframes[4:8])
    assert not back(keyframes, 6, 12, 1.01 * way)
    assert back(keyframes, 6, 12, 0.99 * way)


def test_an_earlier_rotation_elsewhere_is_no_revisit(there_and_back):
    """It turns where it begins, flies on with the place in view, and turns again."""
    keyframes = there_and_back.keyframes
    keyframes[1].anchor[:] = NO_ANCHOR
    for keyframe in keyframes:
        at = np.array([10.0 if keyframe.id > 2 else 0.0, 0.0, 0.0])
        keyframe.T_c_w[:3, 3] = -keyframe.T_c_w[:3, :3] @ at
    assert not back(keyframes, 4, 12, 1.0)


def test_a_slowly_vanishing_view_is_no_loss_of_view(there_and_back):
    keyframes = there_and_back.keyframes
    common = reduce(np.intersect1d, [k.anchor[k.anchor >= 0] for k in keyframes[:4]])
    for few in (3, MIN_SHARED // 2):
        for keyframe in keyframes[4:8]:
            keyframe.anchor[:few] = common[:few]
        assert back(keyframes, 4, 12) == (few == 3)


def test_a_revisited_map_does_not_follow_telemetry(there_and_back):
    newest = there_and_back.keyframes
    assert recent_map(there_and_back.map, newest[-1], 6) is not None, "it only turned"
    for keyframe in newest[4:8]:
        keyframe.T_c_w[:3, 3] += 5.0
    assert recent_map(there_and_back.map, newest[-1], 6) is None
    for keyframe in newest[8:]:
        there_and_back.map.remove_keyframe(keyframe)
    assert [k.id for k in recent_map(there_and_back.map, newest[7], 6).free] == [2, 3, 4, 5, 6, 7]


def spread_of(points, first, last):
    """Extent of the way of some keyframes."""
    return np.ptp(np.array([k.centre_w for k in points.keyframes[first:last]]), axis=0).max()


def test_two_keyframes_or_a_static_camera_are_no_recent_map(halves):
    newest = halves.keyframes[-1]
    assert recent_map(halves.map, newest, 2).fixed
    for keyframe in halves.keyframes:
        keyframe.T_c_w = newest.T_c_w
    assert recent_map(halves.map, newest, 60) is None
    for keyframe in halves.keyframes[:-2]:
        halves.map.remove_keyframe(keyframe)
    assert recent_map(halves.map, newest, 60) is None


@pytest.mark.parametrize("metres", [True, False])
def test_every_second_the_recent_map_is_refined_with_telemetry(rng, metres):
    """Keyframes that hold a drifted scale are beyond the window of two and its two fixed ones."""
    points = filled(rng, 600, 12)
    model = telemetry_of(rng, points)
    model = model if metres else replace(model, velocity=False, scale_sigma_log=np.inf)
    split = 4
    points.part(lambda number: number >= split)
    blow_up(points, 1.4, split)
    config = SlamConfig(mapping=MappingConfig(window=2, window_fixed=2))
    mapper = Mapper(points.map, CAMERA, config, lm_config(config.window))
    newest = points.keyframes[-1]
    mapper.insert(newest, np.zeros((len(newest.anchor), 3), np.uint8), model)
    true = se3.inverse(points.world.T_c_w)[:, :3, 3]
    drift = spread_of(points, split, 8) / np.ptp(true[split:8], axis=0).max()
    drift /= spread_of(points, 0, split) / np.ptp(true[:split], axis=0).max()
    assert 1.0 < drift < 1.25 if metres else drift > 1.35  # half of it at the first time


def test_factors_do_not_connect_submaps(rng, halves):
    model = telemetry_of(rng, halves)
    factors = motion_factors(model, halves.keyframes, [0, 0, 0, 1, 1, 1])
    assert [f.pose.tolist() for f in factors.centres] == [[0, 1, 2], [3, 4, 5]]
    assert [f.pose.tolist() for f in factors.gravity] == [[0, 1, 2], [3, 4, 5]]


def test_loaded_keyframes_have_no_stamp_on_this_clock(rng, halves):
    model = telemetry_of(rng, halves)
    halves.keyframes[0].stamp_s = -np.inf
    told = motion_factors(model, halves.keyframes, [0] * 6)
    assert [factor.pose.tolist() for factor in told.centres] == [[1, 2, 3, 4, 5]]
    assert all(0 not in factor.pose for factor in told.gravity)
    for keyframe in halves.keyframes:
        keyframe.stamp_s = -np.inf
    told = motion_factors(model, halves.keyframes, [0] * 6)
    assert not told.centres and not told.gravity


def tilt_deg(points):
    """Largest tilt of a keyframe's camera against the truth."""
    true = se3.inverse(points.world.T_c_w)[3:, :3, :3]
    mine = np.array([k.T_w_c[:3, :3] for k in points.keyframes[3:]])
    return float(np.degrees(np.arccos(np.clip(np.einsum("ki,ki->k", mine[:, 2], true[:, 2]), -1, 1))).max())


@pytest.mark.parametrize("turn_rad", [0.15, -0.15])
def test_heading_corrects_a_rotated_part_of_the_map(rng, halves, turn_rad):
    """The last three keyframes and what they alone see, turned about the vertical through the third: positions alone
    would move them back and leave them turned."""
    turned_about(halves, [0.0, 0.0, turn_rad])
    assert heading_deg(halves) == pytest.approx(np.degrees(turn_rad), abs=0.1)
    window = Window(halves.keyframes[3:], halves.keyframes[:3], halves.map.anchors_seen_by(halves.keyframes))
    model = replace(telemetry_of(rng, halves), velocity=False)
    refine(halves.map, window, CAMERA, LmConfig(max_iterations=50), model)
    assert abs(heading_deg(halves)) < 0.5
    check_map(halves.map)


def turned_about(points, rotation_vector, first=3):
    """The keyframes from one on and their anchors, turned about the one before it."""
    centre = points.keyframes[first - 1].centre_w
    T = se3.exp(np.concatenate([np.zeros(3), rotation_vector]))
    T[:3, 3] = centre - T[:3, :3] @ centre
    for keyframe in points.keyframes[first:]:
        keyframe.T_c_w = se3.inverse(T @ keyframe.T_w_c)
    mine = points.map.anchors_seen_by(points.keyframes[first:])
    points.map.anchors.p_w[mine] = se3.transform(T, points.map.anchors.p_w[mine])


def heading_deg(points, first=3):
    """Mean turn about the vertical of the keyframes from one on."""
    true = se3.inverse(points.world.T_c_w)
    off = [k.T_w_c[:3, :3] @ true[k.id, :3, :3].T for k in points.keyframes[first:]]
    return float(np.degrees(np.mean(Rotation.from_matrix(np.array(off)).as_rotvec()[:, 2])))


def test_factors_are_those_that_telemetry_determines(rng, halves):
    model = telemetry_of(rng, halves)
    for told, expected in (
        (model, {"centres", "gravity", "headings"}),
        (replace(model, attitude=False), {"centres"}),
        (replace(model, scale_sigma_log=np.inf, velocity=False), {"gravity"}),
        (None, set()),
    ):
        factors = motion_factors(told, halves.keyframes, [0] * 6)
        assert {name for name in ("centres", "gravity", "headings") if getattr(factors, name)} == expected


def test_gravity_alone_levels_an_unconstrained_map(rng, halves):
    turned_about(halves, [0.0, 0.2, 0.0])
    assert tilt_deg(halves) > 10.0
    model = replace(telemetry_of(rng, halves), velocity=False)
    assert not motion_factors(model, halves.keyframes, [0] * 6).centres
    window = Window(halves.keyframes[3:], halves.keyframes[:3], halves.map.anchors_seen_by(halves.keyframes))
    refine(halves.map, window, CAMERA, LmConfig(max_iterations=50), model)
    assert tilt_deg(halves) < 0.5


def test_gravity_dominates_in_a_new_map_without_metric_scale(rng, halves):
    """Then depths are guesses, and a drone's attitude has the error of its quantisation; not after that."""
    model = telemetry_of(rng, halves)
    (before,), (after,) = (
        motion_factors(m, halves.keyframes, [0] * 6).gravity
        for m in (replace(model, scale_sigma_log=np.inf, velocity=False, new_map=True), model)
    )
    assert np.degrees(before.sigma_rad) < 0.4 < 0.5 < np.degrees(after.sigma_rad)


@pytest.mark.parametrize("early_s", [0.0, 1.3])
def test_the_vertical_since_a_keyframe_is_in_the_world_of_its_pose(rng, halves, early_s):
    """However that leans, and although its picture may be older than the first message."""
    model = replace(telemetry_of(rng, halves), delay_s=0.5)
    reference, newest = halves.keyframes[0], halves.keyframes[-1]
    reference.stamp_s += model.delay_s - early_s
    true = halves.world.T_c_w[5] @ se3.inverse(halves.world.T_c_w[0])
    reference.T_c_w = reference.T_c_w @ se3.exp(np.array([0.5, 0.0, 1.0, 0.3, -0.2, 0.1]))
    found = vertical_since(model, reference, newest.stamp_s + model.delay_s)
    np.testing.assert_allclose(found.up_c, true[:3, :3] @ reference.T_c_w[:3, :3] @ found.up_w, atol=1e-3)


def test_the_vertical_since_a_keyframe_needs_a_message_before_it(rng, halves):
    reference, at_s = halves.keyframes[0], halves.keyframes[-1].stamp_s
    reference.stamp_s = -2.0
    assert vertical_since(telemetry_of(rng, halves), reference, at_s) is None
    assert vertical_since(None, reference, at_s) is None


def test_a_whole_map_may_use_the_full_weight_of_telemetry(rng, halves):
    """In a window of the flight 120 times, beside keypoints that err together; attitude thirty times."""
    model, keyframes = telemetry_of(rng, halves), halves.keyframes
    flying = Window(keyframes[1:], keyframes[:1], halves.map.anchors_seen_by(keyframes))
    one, often = (
        window_problem(halves.map, w, CAMERA, LmConfig(), model)[0]
        for w in (whole_map(halves.map, effective_samples=1.0), flying)
    )
    for once, again in zip(one.centres, often.centres, strict=True):
        np.testing.assert_allclose(EFFECTIVE_SAMPLES * once.information, again.information, rtol=1e-6)
        np.testing.assert_allclose(EFFECTIVE_SAMPLES * once.vector, again.vector, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(one.gravity[0].sigma_rad, math.sqrt(30.0) * often.gravity[0].sigma_rad)
    np.testing.assert_allclose(30.0 * one.headings[0].information, often.headings[0].information)


@pytest.mark.parametrize("metres", [1.0, 0.2])
def test_a_weakly_connected_keyframe_stays_at_a_plausible_pose(rng, metres):
    """The first of six, a fifth of a second apart: nothing else sees what it shares with the second one."""
    points = filled(rng, 400, 6)
    first, second, *rest = points.keyframes
    shared = np.intersect1d(first.anchor[first.anchor >= 0], second.anchor[second.anchor >= 0])
    for keyframe in points.keyframes:
        keyframe.stamp_s = 0.2 * keyframe.id
        pair, held = keyframe in (first, second), keyframe.anchor
        lost = np.isin(held, shared[::2]) & ~pair | (held >= 0) & ~np.isin(held, shared[::2]) & (keyframe is first)
        points.map.forget_observations(keyframe, np.flatnonzero(lost))
    right, start = first.centre_w, second.centre_w
    own = points.map.anchors_seen_by([first])
    T_w_c = first.T_w_c
    T_w_c[:3, 3] = start + 30.0 * (right - start)
    first.T_c_w = se3.inverse(T_w_c)
    points.map.anchors.p_w[own] = start + 30.0 * (points.map.anchors.p_w[own] - start)
    off = np.linalg.norm(first.centre_w - right)
    window = Window([first], [second, *rest], own)
    solver = LmConfig(max_iterations=100)
    refine(points.map, window, CAMERA, solver)
    assert np.linalg.norm(first.centre_w - right) > 0.9 * off
    silent = replace(telemetry_of(rng, points), velocity=False, attitude=False, scale=metres)
    refine(points.map, window, CAMERA, solver, silent)
    assert np.linalg.norm(first.centre_w - right) < min(1.05 / metres, 0.25 * off)
    check_map(points.map)


def test_an_attitude_between_two_readings_is_as_uncertain_as_what_the_drone_leaned(halves):
    """A drone that pitches by six degrees within a reading's time; before and after it stands still."""
    t = np.arange(-1.0, 6.0, 0.1)
    rpy_rad = np.zeros((len(t), 3))
    rpy_rad[t > 2.45, 1] = math.radians(6.0)
    track = TelemetryTrack("world", 0.35)
    track.add([TelemetrySample(s, np.zeros(3), rpy) for s, rpy in zip(t.tolist(), rpy_rad, strict=True)])
    model = TelemetryModel(track, FusionConfig(), T_B_C, np.eye(3), 0.0, 0.0, 1.0, 0.01, True, None, truncates=0.0)
    first = replace(halves.keyframes[0], stamp_s=0.0)
    systematic_deg = [math.degrees(vertical_since(model, first, s).systematic_rad) for s in (1.5, 2.45, 3.5)]
    assert systematic_deg[0] < 0.1 and systematic_deg[2] < 0.1
    assert 2.0 < systematic_deg[1] < 6.0


def test_keyframes_that_attitude_contradicts_may_be_moved_by_all_that_sensors_measure(rng, halves, monkeypatch):
    """The last keyframe leans by four degrees: its displacements are no outliers, whatever the map says."""
    model, guessed = telemetry_of(rng, halves), []
    right = TelemetryModel.positions
    monkeypatch.setattr(TelemetryModel, "positions", lambda *a: guessed.append(a[-1]) or right(*a))
    motion_factors(model, halves.keyframes, [0] * 6)
    lean = se3.exp(np.array([0.0, 0.0, 0.0, math.radians(4.0), 0.0, 0.0]))
    halves.keyframes[5].T_c_w = lean @ halves.keyframes[5].T_c_w
    motion_factors(model, halves.keyframes, [0] * 6)
    assert [list(flags) for flags in guessed] == [[False] * 6, [False] * 5 + [True]]
