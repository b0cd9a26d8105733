"""Telemetry in a window: a part of the map that hangs on nothing else keeps scale and place."""

from dataclasses import replace

import numpy as np
import pytest
from point_map import CAMERA, PointMap, check_map
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.displacement import TelemetryModel
from edgeslam_torch.fusion.telemetry.track import TelemetryTrack
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.mapping.motion_terms import motion_factors
from edgeslam_torch.mapping.refinement import Window, refine
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.synthetic.flights.telemetry import EXACT, simulate

T_B_C = camera_on_body()


@pytest.fixture
def halves(rng):
    """Six keyframes, one a second: the first three share no anchor with the last three."""
    points = PointMap(rng, 400, 6)
    points.fill()
    for keyframe in points.keyframes:
        other = np.flatnonzero((keyframe.anchor >= 0) & (keyframe.anchor % 2 != (keyframe.id >= 3)))
        points.map.forget_observations(keyframe, other)
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


def blow_up(points, factor):
    """The last three keyframes and their anchors, scaled about the third."""
    centre = points.keyframes[2].centre_w
    for keyframe in points.keyframes[3:]:
        T_w_c = keyframe.T_w_c
        T_w_c[:3, 3] = centre + factor * (T_w_c[:3, 3] - centre)
        keyframe.T_c_w = se3.inverse(T_w_c)
    mine = points.map.anchors_seen_by(points.keyframes[3:])
    points.map.anchors.p_w[mine] = centre + factor * (points.map.anchors.p_w[mine] - centre)


def far(points):
    true = se3.inverse(points.world.T_c_w)[3:, :3, 3]
    return max(float(np.linalg.norm(k.centre_w - c)) for k, c in zip(points.keyframes[3:], true, strict=True))


@pytest.mark.parametrize("factor", [0.7, 1.4])
@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_scale_is_carried_over_to_what_shares_no_anchor(rng, halves, factor, scale):
    blow_up(halves, factor)
    off = far(halves)
    window = Window(halves.keyframes[3:], halves.keyframes[:3], halves.map.anchors_seen_by(halves.keyframes))
    refine(halves.map, window, CAMERA, LmConfig())
    assert far(halves) > 0.9 * off
    refine(halves.map, window, CAMERA, LmConfig(max_iterations=50), telemetry_of(rng, halves, scale))
    assert far(halves) < 0.05 * off
    check_map(halves.map)


def test_pieces_are_not_tied_to_each_other(rng, halves):
    model = telemetry_of(rng, halves)
    factors = motion_factors(model, halves.keyframes, [0, 0, 0, 1, 1, 1])
    assert [f.pose.tolist() for f in factors.centres] == [[0, 1, 2], [3, 4, 5]]
    assert [f.pose.tolist() for f in factors.gravity] == [[0, 1, 2], [3, 4, 5]]


def test_keyframes_of_earlier_flights_have_no_time_on_this_clock(rng, halves):
    model = telemetry_of(rng, halves)
    halves.keyframes[0].stamp_s = -np.inf
    told = motion_factors(model, halves.keyframes, [0] * 6)
    assert [factor.pose.tolist() for factor in told.centres] == [[1, 2, 3, 4, 5]]
    assert all(0 not in factor.pose for factor in told.gravity)
    for keyframe in halves.keyframes:
        keyframe.stamp_s = -np.inf
    told = motion_factors(model, halves.keyframes, [0] * 6)
    assert not told.centres and not told.gravity


def test_poses_come_in_any_order(rng, halves):
    model, shuffled = telemetry_of(rng, halves), [halves.keyframes[i] for i in (4, 0, 5, 2, 1, 3)]
    (factor,) = motion_factors(model, shuffled, [0] * 6).centres
    assert [shuffled[i].id for i in factor.pose] == [0, 1, 2, 3, 4, 5]


def tilted(points, angle_rad):
    """The last three keyframes and their anchors, turned about a level axis through the third."""
    R, centre = Rotation.from_rotvec([0.0, angle_rad, 0.0]).as_matrix(), points.keyframes[2].centre_w
    for keyframe in points.keyframes[3:]:
        T_w_c = keyframe.T_w_c
        T_w_c[:3, :3], T_w_c[:3, 3] = R @ T_w_c[:3, :3], centre + R @ (T_w_c[:3, 3] - centre)
        keyframe.T_c_w = se3.inverse(T_w_c)
    mine = points.map.anchors_seen_by(points.keyframes[3:])
    points.map.anchors.p_w[mine] = centre + (points.map.anchors.p_w[mine] - centre) @ R.T


def tilt_deg(points):
    """Largest tilt of a keyframe's camera against the truth."""
    true = se3.inverse(points.world.T_c_w)[3:, :3, :3]
    mine = np.array([k.T_w_c[:3, :3] for k in points.keyframes[3:]])
    return float(np.degrees(np.arccos(np.clip(np.einsum("ki,ki->k", mine[:, 2], true[:, 2]), -1, 1))).max())


def test_gravity_alone_holds_level_what_nothing_else_holds(rng, halves):
    tilted(halves, 0.2)
    assert tilt_deg(halves) > 10.0
    model = replace(telemetry_of(rng, halves), velocity=False)
    assert not motion_factors(model, halves.keyframes, [0] * 6).centres
    window = Window(halves.keyframes[3:], halves.keyframes[:3], halves.map.anchors_seen_by(halves.keyframes))
    refine(halves.map, window, CAMERA, LmConfig(max_iterations=50), model)
    assert tilt_deg(halves) < 0.5


def test_gravity_weighs_against_a_window_as_the_rest_of_telemetry_does(rng, halves):
    """Keyframes a second apart: three are within half of the 5 s that an error of attitude lasts."""
    model = telemetry_of(rng, halves)
    (gravity,) = motion_factors(model, halves.keyframes, [0] * 6).gravity
    assert np.degrees(gravity.sigma_rad) == pytest.approx(2.0 * np.sqrt(5.0) / np.sqrt(30.0), rel=0.15)


def test_attitude_that_may_not_speak_gives_no_gravity(rng, halves):
    model = replace(telemetry_of(rng, halves), attitude=False)
    factors = motion_factors(model, halves.keyframes, [0] * 6)
    assert factors.centres and not factors.gravity


def test_no_telemetry_no_factors(halves):
    factors = motion_factors(None, halves.keyframes, [0] * 6)
    assert not factors.centres and not factors.gravity
