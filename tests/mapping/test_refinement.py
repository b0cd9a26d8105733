"""Window choice and refinement as the map sees them."""

import numpy as np
import pytest
from point_map import CAMERA, check_map, filled, small_motion

from edgeslam_torch.config import WindowConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.last_refinement import lm_config
from edgeslam_torch.mapping.refinement import (
    choose_window,
    new_map,
    recent_map,
    refine,
    refine_all,
    window_problem,
)
from edgeslam_torch.mapping.window_scale import with_same_depths
from edgeslam_torch.optim.pose_only import refine_pose
from edgeslam_torch.optim.problem import LmConfig, StopReason, WindowResult


@pytest.fixture
def points(rng):
    return filled(rng, 300, 6)


def pose_errors(points, keyframes):
    xi = [se3.log(k.T_c_w @ se3.inverse(points.world.T_c_w[k.id])) for k in keyframes]
    return np.linalg.norm(xi, axis=1)


@pytest.mark.parametrize(("free", "fixed"), [(3, 2), (4, 15), (10, 15)])
def test_at_least_two_keyframes_fix_the_gauge(points, free, fixed):
    newest = points.keyframes[-1]
    window = choose_window(points.map, newest, free, fixed)
    assert newest in window.free
    assert 2 <= len(window.fixed) <= max(fixed, 2)
    assert len(window.free) <= free
    inside = {k.id for k in (*window.free, *window.fixed)}
    assert len(inside) == len(window.free) + len(window.fixed)
    shared = points.map.shared_counts(window.anchor)
    left_out = [count for id, count in shared.items() if id not in inside]
    assert all(shared[k.id] >= max(left_out, default=0) for k in window.fixed), "those that share most are fixed"
    np.testing.assert_array_equal(window.anchor, points.map.anchors_seen_by(window.free))


@pytest.mark.parametrize("what", ["anchor", "pixel"])
def test_a_window_that_cannot_be_refined_is_unchanged(points, what):
    """A NaN in the solver's result leaves poses, anchors and observations unchanged."""
    window = choose_window(points.map, points.keyframes[-1], 4, 15)
    if what == "anchor":
        points.map.anchors.p_w[window.anchor[3]] = np.nan
    else:
        points.keyframes[-1].features.uv[points.keyframes[-1].keypoints_with_anchor()[0]] = np.inf
    held = [k.anchor.copy() for k in points.keyframes]
    result = refine(points.map, window, CAMERA, LmConfig())
    assert result.stop is StopReason.NOT_FINITE
    for keyframe, before in zip(points.keyframes, held, strict=True):
        np.testing.assert_array_equal(keyframe.anchor, before)
        np.testing.assert_array_equal(keyframe.T_c_w, points.world.T_c_w[keyframe.id])
    check_map(points.map)


@pytest.mark.parametrize(("robust", "aligned"), [(True, False), (False, False), (True, True)])
def test_keypoints_are_weighted_by_their_pyramid_level_or_their_alignment(points, robust, aligned):
    """A keypoint of level 3 scatters by 1.728 px; in the paper's plain squares all count alike."""
    window = choose_window(points.map, points.keyframes[-1], 4, 15)
    newest = points.keyframes[-1]
    newest.features.octave[:] = 3
    newest.aligned_px[::2] = 0.5 if aligned else np.nan
    problem, keypoint = window_problem(points.map, window, CAMERA, LmConfig(robust=robust))
    pose = [*window.free, *window.fixed].index(newest)
    mine = problem.obs_pose == pose
    assert mine.sum() == len(keypoint[pose]) > 20
    expected = np.where((keypoint[pose] % 2 == 0) & aligned, 0.5, 1.2**3 if robust else 1.0)
    np.testing.assert_allclose(1.0 / problem.inv_sigma[mine], expected)
    np.testing.assert_allclose(problem.inv_sigma[~mine], 1.0)


def test_outlier_observations_are_removed_from_the_map(points, rng):
    keyframe = points.keyframes[-1]
    wrong = rng.permutation(keyframe.keypoints_with_anchor())[:20]
    keyframe.features.uv[wrong] += 30.0
    window = choose_window(points.map, keyframe, 4, 15)
    inside = np.isin(keyframe.anchor[wrong], window.anchor)
    refine(points.map, window, CAMERA, LmConfig())
    assert (keyframe.anchor[wrong[inside]] < 0).all()
    right = np.setdiff1d(np.arange(len(keyframe.anchor)), wrong)
    assert np.mean(keyframe.anchor[right] >= 0) > 0.9
    # The robust kernel leaves a little of what twenty wrong ones of eighty pull.
    assert pose_errors(points, window.free).max() < 0.01
    check_map(points.map)


def test_no_observation_is_removed_before_convergence(points, rng):
    """The solver runs out of steps far from the minimum, where right observations do not fit either."""
    keyframe = points.keyframes[-1]
    keyframe.T_c_w = small_motion(rng, 0.3, 0.1) @ keyframe.T_c_w
    before = keyframe.anchor.copy()
    window = choose_window(points.map, keyframe, 4, 15)
    result = refine(points.map, window, CAMERA, LmConfig(max_iterations=1, mu=1.0))
    assert result.stop is StopReason.MAX_ITERATIONS
    assert np.mean(result.chi2 > 5.991) > 0.1
    np.testing.assert_array_equal(keyframe.anchor, before)
    check_map(points.map)


def test_a_wide_window_is_written_back_only_if_converged(points, rng):
    for keyframe in points.keyframes[1:]:
        keyframe.T_c_w = small_motion(rng, 0.3, 0.1) @ keyframe.T_c_w
    before = [k.T_c_w.copy() for k in points.keyframes]
    window = recent_map(points.map, points.keyframes[-1], 60)
    refine(points.map, window, CAMERA, LmConfig(max_iterations=1, mu=1.0))
    np.testing.assert_array_equal([k.T_c_w for k in points.keyframes], before)
    result = refine(points.map, window, CAMERA, LmConfig(max_iterations=50))
    assert result.stop.converged
    assert any((k.T_c_w != T).any() for k, T in zip(points.keyframes, before, strict=True))


def test_a_window_of_two_keyframes_keeps_its_scale(rng):
    points = filled(rng, 100, 2)
    a, b = points.keyframes
    window = choose_window(points.map, b, 10, 15)
    assert ([k.id for k in window.free], [k.id for k in window.fixed]) == ([b.id], [a.id])
    points.map.anchors.p_w[window.anchor] *= 1.1  # all that the points say is that the scene is larger
    before = np.linalg.norm(b.centre_w - a.centre_w)
    result = refine(points.map, window, CAMERA, LmConfig())
    assert np.linalg.norm(b.centre_w - a.centre_w) == pytest.approx(before, rel=1e-3)
    assert result.rank_deficiency == 0
    check_map(points.map)


def test_the_whole_map_is_recovered_up_to_its_gauge(points, rng):
    """The first pose and the distance to the farthest keyframe are held, the rest is free."""
    first, far = points.keyframes[0], points.keyframes[-1]
    for keyframe in points.keyframes[1:-1]:
        keyframe.T_c_w = small_motion(rng, 0.02, 0.01) @ keyframe.T_c_w
    ids = np.flatnonzero(points.map.anchors.alive)
    points.map.anchors.p_w[ids] += rng.normal(0.0, 0.02, (len(ids), 3))
    refine_all(points.map, CAMERA, LmConfig())
    np.testing.assert_array_equal(first.T_c_w, points.world.T_c_w[0])
    assert pose_errors(points, points.keyframes).max() < 1e-3
    truth = np.linalg.norm(se3.inverse(points.world.T_c_w[-1])[:3, 3] - first.centre_w)
    assert np.linalg.norm(far.centre_w - first.centre_w) == pytest.approx(truth, rel=1e-3)
    check_map(points.map)


def test_the_scale_of_a_loaded_map_is_preserved(points):
    """What this flight adds is a tenth too far off: it comes to the earlier map, not the other way round."""
    earlier, later = points.keyframes[:3], points.keyframes[3:]
    origin = earlier[0].centre_w
    for keyframe in earlier:
        keyframe.stamp_s = -np.inf
    for keyframe in later:
        keyframe.T_c_w[:3, 3] = -keyframe.T_c_w[:3, :3] @ (origin + 1.1 * (keyframe.centre_w - origin))
    refine_all(points.map, CAMERA, LmConfig(max_iterations=30))
    truth = -np.einsum("kji,kj->ki", points.world.T_c_w[:, :3, :3], points.world.T_c_w[:, :3, 3])
    for keyframe in points.keyframes[1:]:
        far = np.linalg.norm(truth[keyframe.id] - origin)
        assert np.linalg.norm(keyframe.centre_w - origin) == pytest.approx(far, rel=5e-3)
    check_map(points.map)


def test_map_of_a_static_camera_is_not_refined(points):
    """Zero extent cannot fix the gauge; this once divided by zero on a folder of images from one place."""
    for keyframe in points.map.keyframes.values():
        keyframe.T_c_w = np.eye(4)
    assert refine_all(points.map, CAMERA, LmConfig()) is None


def bend(points):
    """The map as a network would begin it that halves the range of log depth, each pose the best in that map."""
    first, anchors = points.keyframes[0], points.map.anchors
    ids = np.flatnonzero(anchors.alive)
    p_c = se3.transform(first.T_c_w, anchors.p_w[ids])
    depth = np.abs(p_c[:, 2:])
    anchors.p_w[ids] = se3.transform(first.T_w_c, p_c * np.sqrt(np.median(depth) / depth))
    for keyframe in points.keyframes[1:]:
        seen = keyframe.keypoints_with_anchor()
        uv, p_w = keyframe.features.uv[seen].astype(np.float64), anchors.p_w[keyframe.anchor[seen]]
        K = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)
        keyframe.T_c_w = refine_pose(keyframe.T_c_w, p_w, uv, np.ones(len(uv)), K).T_c_w


def worst_turn_deg(points):
    T_w_c0 = points.keyframes[0].T_w_c @ points.world.T_c_w[0]
    turns = [se3.log(k.T_c_w @ T_w_c0 @ se3.inverse(points.world.T_c_w[k.id]))[3:] for k in points.keyframes]
    return np.degrees(np.linalg.norm(turns, axis=1).max())


def median_depth(points):
    """Of what the first keyframe sees [map units]."""
    first = points.keyframes[0]
    seen = first.anchor[first.anchor >= 0]
    return np.median(se3.transform(first.T_c_w, points.map.anchors.p_w[seen])[:, 2])


def test_a_new_map_of_a_wrong_shape_is_corrected(rng):
    """Where one pose and one distance are held, and the solver does not stop early."""
    points = filled(rng, 300, 6, noise_px=0.3)
    bend(points)
    assert worst_turn_deg(points) > 1.0
    before = median_depth(points)
    window = new_map(points.map, points.keyframes[-1], 25)
    refine(points.map, window, CAMERA, lm_config(WindowConfig()))
    assert worst_turn_deg(points) < 0.1
    assert median_depth(points) == pytest.approx(before, rel=0.02)
    check_map(points.map)


def test_the_scale_of_a_new_map_is_fixed_by_refined_poses(points, rng):
    """The newest keyframe, the farthest one, comes as tracking placed it: its error must not become the map's scale."""
    newest, centre = points.keyframes[-1], points.keyframes[0].centre_w
    distance = [np.linalg.norm(k.centre_w - centre) for k in points.keyframes]
    T_w_c = newest.T_w_c.copy()
    T_w_c[:3, 3] += 0.1 * (newest.centre_w - centre)
    newest.T_c_w = se3.inverse(T_w_c)
    refine(points.map, new_map(points.map, newest, 25), CAMERA, LmConfig())
    after = [np.linalg.norm(k.centre_w - centre) for k in points.keyframes]
    np.testing.assert_allclose(after, distance, rtol=2e-3, atol=1e-6)


def test_the_scale_of_a_flight_that_began_at_a_standstill_is_kept(rng):
    """Its first keyframes differ by noise, from which a tutorial's first flight once grew eightfold in one window."""
    points = filled(rng, 300, 14)
    for keyframe in points.keyframes[1:4]:
        keyframe.T_c_w = small_motion(rng, 1e-3, 1e-4) @ points.keyframes[0].T_c_w
    window = recent_map(points.map, points.keyframes[-1], 60)
    problem, _ = window_problem(points.map, window, CAMERA, LmConfig())
    T_c_w = problem.T_c_w.copy()
    T_c_w[:3] = [small_motion(rng, 5e-3, 1e-4) @ T for T in T_c_w[:3]]
    chi2 = np.zeros(len(problem.obs_pose))
    refined = WindowResult(T_c_w, problem.p_w, chi2, 1.0, 1.0, 1, StopReason.STEP_CONVERGED)
    np.testing.assert_allclose(with_same_depths(problem, refined, 13, 3).p_w, problem.p_w, rtol=0.01, atol=0.01)


def test_only_a_small_map_is_new(points):
    newest = points.keyframes[-1]
    assert new_map(points.map, newest, len(points.keyframes)).free[-1] is newest
    assert new_map(points.map, newest, len(points.keyframes) - 1) is None
    for keyframe in points.keyframes[1:-1]:
        points.map.remove_keyframe(keyframe)
    assert new_map(points.map, newest, 25) is None  # two keyframes leave nothing to straighten
