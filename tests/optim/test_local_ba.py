"""Window refinement on clean, contaminated and degenerate synthetic worlds."""

from dataclasses import replace

import numpy as np
import pytest
from numeric import pixels
from seeded_window import (
    K,
    Noise,
    SeededWindow,
    WindowSize,
    points_only,
    refine_with_gtsam,
    seeded_window,
)

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.problem import (
    DepthPriors,
    LmConfig,
    ScalePrior,
    StopReason,
    WindowProblem,
    WindowResult,
)

SMALL = WindowSize(poses=6, fixed=2, anchors=150, observations=600, edges=200, pairs=600, junctions=20)
CLEAN = Noise(px=0.0, depth=0.0)
TIGHT = LmConfig(max_iterations=60, cost_tolerance=1e-13)


def pose_error(result: WindowResult, window: SeededWindow) -> float:
    return max(
        float(np.abs(se3.log(T @ se3.inverse(true))).max()) for T, true in zip(result.T_c_w, window.T_c_w, strict=True)
    )


def keep(problem: WindowProblem, which: np.ndarray) -> WindowProblem:
    return replace(
        problem,
        obs_pose=problem.obs_pose[which],
        obs_anchor=problem.obs_anchor[which],
        uv=problem.uv[which],
        inv_sigma=problem.inv_sigma[which],
    )


def without_points(problem: WindowProblem) -> WindowProblem:
    return replace(keep(problem, np.zeros(len(problem.uv), bool)), p_w=np.zeros((0, 3)))


def baselines(T_c_w: np.ndarray) -> np.ndarray:
    centres = se3.inverse(T_c_w)[:, :3, 3]
    return np.linalg.norm(np.diff(centres, axis=0), axis=1)


# -- clean worlds ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("part", ["points", "edges", "everything"])
def test_a_noise_free_window_is_recovered_exactly(part):
    window = seeded_window(1, SMALL, CLEAN)
    problem = window.problem
    if part == "points":
        problem = points_only(window).problem
    if part == "edges":
        problem = replace(without_points(problem), junctions=None)
    result = refine_window(problem, TIGHT)
    assert result.stop.converged
    assert result.cost_after < 1e-10 < result.cost_before
    assert pose_error(result, window) < 1e-7
    assert result.rank_deficiency == 0
    if part != "edges":
        seen = np.bincount(problem.obs_anchor, minlength=len(problem.p_w)) >= 2
        assert np.abs(result.p_w - window.p_w)[seen].max() < 1e-5
        assert result.chi2.max() < 1e-8


def test_unobserved_anchors_and_fixed_poses_do_not_move():
    window = seeded_window(2, SMALL, CLEAN)
    problem = keep(window.problem, window.problem.obs_anchor != 7)
    result = refine_window(problem, TIGHT)
    np.testing.assert_array_equal(result.p_w[7], problem.p_w[7])
    np.testing.assert_array_equal(result.T_c_w[:2], problem.T_c_w[:2])


def test_chi2_is_in_the_callers_order():
    window = seeded_window(3, SMALL)
    result = refine_window(window.problem, TIGHT)
    problem = window.problem
    p_c = np.einsum("nij,nj->ni", result.T_c_w[problem.obs_pose][:, :3, :3], result.p_w[problem.obs_anchor])
    p_c += result.T_c_w[problem.obs_pose][:, :3, 3]
    expected = np.square((pixels(p_c, K) - problem.uv) * problem.inv_sigma[:, None]).sum(1)
    np.testing.assert_allclose(result.chi2, expected, rtol=1e-9, atol=1e-20)


def test_an_anchor_practically_at_infinity_disturbs_nothing():
    problem = points_only(seeded_window(5, SMALL)).problem
    held = replace(problem, scale_priors=(ScalePrior(0, 5, 0.6, 0.01),))
    near = refine_window(held, TIGHT)
    far = np.array([[1e9, 2e9, 1e11]])  # seen by one pose, along its ray: it says nothing
    ray = far[0] @ problem.T_c_w[0, :3, :3].T + problem.T_c_w[0, :3, 3]
    with_far = replace(
        held,
        p_w=np.concatenate((problem.p_w, far)),
        obs_pose=np.append(problem.obs_pose, 0),
        obs_anchor=np.append(problem.obs_anchor, len(problem.p_w)),
        uv=np.concatenate((problem.uv, pixels(ray[None], K))),
        inv_sigma=np.append(problem.inv_sigma, 1.0),
    )
    result = refine_window(with_far, TIGHT)
    assert result.cost_after == pytest.approx(near.cost_after, rel=1e-8)
    np.testing.assert_allclose(result.T_c_w, near.T_c_w, atol=1e-6)
    assert result.rank_deficiency == near.rank_deficiency


# -- noise ----------------------------------------------------------------------------------------------------


def test_outliers_are_identified_and_do_not_affect_the_poses(rng):
    window = points_only(seeded_window(8, WindowSize(poses=6, fixed=2, anchors=200, observations=1000)))
    problem = window.problem
    bad = np.zeros(len(problem.uv), bool)
    bad[rng.permutation(len(bad))[:80]] = True
    dirty = replace(problem, uv=problem.uv + bad[:, None] * rng.uniform(-60, 60, problem.uv.shape))
    clean = refine_window(problem, TIGHT)
    result = refine_window(dirty, TIGHT)
    assert pose_error(result, window) < 3 * pose_error(clean, window)
    far = bad & (np.abs(dirty.uv - problem.uv).max(1) > 20)
    seen = np.bincount(problem.obs_anchor[~bad], minlength=len(problem.p_w))[problem.obs_anchor] >= 3
    assert (result.chi2[far & seen] > 5.991).mean() > 0.95
    assert (result.chi2[~bad] > 5.991).mean() < 0.15


def test_covariance_of_the_newest_pose_matches_its_scatter():
    size = WindowSize(poses=4, fixed=2, anchors=60, observations=200, edges=0, junctions=0)
    window = seeded_window(10, size)
    config = LmConfig(robust=False, max_iterations=8)
    clean = seeded_window(10, size, CLEAN).problem.uv
    whitened = []
    for seed in range(120):
        noise = 0.7 * np.random.default_rng(seed).normal(size=clean.shape)
        result = refine_window(replace(window.problem, uv=clean + noise), config)
        xi = se3.log(result.T_c_w[-1] @ se3.inverse(window.T_c_w[-1]))
        whitened.append(np.linalg.solve(np.linalg.cholesky(result.pose_covariance), xi))
    # 120 draws: the standard error of a mean of 6 * 120 unit chi-squares is sqrt(2 / 720) = 0.05.
    assert np.square(whitened).mean() == pytest.approx(1.0, abs=0.2)


# -- gauge and priors -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("fixed, missing", [(0, 7), (1, 1), (2, 0)])
def test_rank_deficiency_counts_the_free_gauge(fixed, missing):
    problem = points_only(seeded_window(12, replace(SMALL, fixed=fixed))).problem
    result = refine_window(problem, TIGHT)
    assert result.rank_deficiency == missing
    assert result.stop.converged


def test_scale_prior_sets_the_distance():
    problem = points_only(seeded_window(13, replace(SMALL, fixed=1))).problem
    prior = ScalePrior(0, 5, distance=1.3, sigma_log=1e-3)
    result = refine_window(replace(problem, scale_priors=(prior,)), TIGHT)
    c = se3.inverse(result.T_c_w)[:, :3, 3]
    assert np.linalg.norm(c[5] - c[0]) == pytest.approx(1.3, rel=1e-3)
    assert result.rank_deficiency == 0


def test_depth_priors_set_the_scale(rng):
    window = points_only(seeded_window(14, replace(SMALL, fixed=1)))
    z = (window.p_w @ window.T_c_w[0, :3, :3].T + window.T_c_w[0, :3, 3])[:, 2]
    some = np.flatnonzero(z > 1.0)[:80]
    noisy = 1.0 / z[some] * np.exp(0.05 * rng.normal(size=len(some)))
    prior = DepthPriors(some, np.zeros(len(some), int), noisy, 0.05 * noisy)
    result = refine_window(replace(window.problem, depth_priors=prior), TIGHT)
    ratio = baselines(result.T_c_w) / baselines(window.T_c_w)
    # Over 30 seeds the scale scatters by 1.9 % (mean 1.008): four views of 12 cm steps give poor depths themselves.
    assert np.median(ratio) == pytest.approx(1.0, abs=0.06)
    assert result.rank_deficiency == 0
    assert len(result.chi2) == len(window.problem.uv)


@pytest.mark.parametrize("seed", range(2))
def test_a_search_ended_by_the_poses_is_at_the_minimum_within_the_tolerance(seed):
    """The distance of the costs is the squared distance of the states in standard deviations."""
    problem = points_only(seeded_window(seed, SMALL)).problem
    tight = refine_window(problem, TIGHT)
    early = refine_window(problem, replace(TIGHT, mu=1e-8, pose_tolerance=1.0))
    assert early.stop is StopReason.STEP_CONVERGED
    assert early.iterations < tight.iterations
    fixed = replace(problem, T_c_w=early.T_c_w, p_w=early.p_w, pose_fixed=np.ones(len(problem.T_c_w), bool))
    assert refine_window(fixed, TIGHT).cost_after - tight.cost_after < 1.0


# -- degenerate windows ---------------------------------------------------------------------------------------


CHANGES = {
    "all points behind": lambda p: replace(p, p_w=p.p_w * np.array([1, 1, -1.0])),
    "points on the camera plane": lambda p: replace(p, p_w=p.p_w * np.array([1, 1, 0.0])),
    "no observations": lambda p: keep(p, np.zeros(len(p.uv), bool)),
    "nothing free": lambda p: replace(p, pose_fixed=np.ones(len(p.T_c_w), bool)),
    "every anchor seen once": lambda p: keep(p, p.obs_pose == p.obs_anchor % len(p.T_c_w)),
    "not finite": lambda p: replace(p, uv=np.where(np.arange(len(p.uv))[:, None] == 3, np.nan, p.uv)),
}
NAMES = ["pure rotation", "no motion", "one plane", "one line", "two keyframes", *CHANGES]


def degenerate(name: str, rng: np.random.Generator) -> WindowProblem:
    p_w = rng.uniform((-1, -1, 3), (1, 1, 6), (60, 3))
    step = {"pure rotation": [0, 0, 0, 0.01, 0.05, 0], "no motion": [0.0] * 6}.get(name, [-0.1, 0, 0, 0, 0.02, 0])
    T = np.stack([se3.exp(np.array(step) * i) for i in range(2 if name == "two keyframes" else 4)])
    if name == "one plane":
        p_w[:, 2] = 4.0
    if name == "one line":
        p_w[:] = p_w[:1] + np.linspace(0, 1, 60)[:, None] * np.array([1.0, 0.5, 0.5])
    pose, anchor = np.divmod(np.arange(len(T) * len(p_w)), len(p_w))
    p_c = np.einsum("nij,nj->ni", T[pose][:, :3, :3], p_w[anchor]) + T[pose][:, :3, 3]
    uv = pixels(p_c, K) + 0.5 * rng.normal(size=(len(pose), 2))
    start = p_w + 0.05 * rng.normal(size=p_w.shape)
    problem = WindowProblem(T, np.arange(len(T)) < 1, start, pose, anchor, uv, np.ones(len(pose)), K)
    return CHANGES.get(name, lambda p: p)(problem)


@pytest.mark.parametrize("name", NAMES)
def test_degenerate_window_ends_with_a_reason_and_a_finite_state(name, rng):
    problem = degenerate(name, rng)
    result = refine_window(problem, LmConfig(max_iterations=25))
    assert isinstance(result.stop, StopReason)
    assert np.isfinite(result.T_c_w).all()
    assert np.isfinite(result.p_w).all()
    assert result.chi2.shape == (len(problem.obs_pose),)
    R = result.T_c_w[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-9)
    if result.iterations:
        assert result.cost_after <= result.cost_before
    expected = {
        "no observations": StopReason.NO_OBSERVATIONS,
        "all points behind": StopReason.NO_OBSERVATIONS,
        "not finite": StopReason.NOT_FINITE,
    }
    assert result.stop is expected.get(name, result.stop)
    if name == "all points behind":
        assert np.isinf(result.chi2).all()
        np.testing.assert_array_equal(result.T_c_w, problem.T_c_w)
    if name in ("no motion", "every anchor seen once", "pure rotation", "two keyframes"):
        assert result.rank_deficiency >= 1


@pytest.mark.parametrize(
    "change, message",
    [
        ({"obs_pose": np.array([0])}, "equally long"),
        ({"pose_fixed": np.array([True])}, "pose_fixed"),
        ({"obs_anchor": np.full(600, 150)}, "obs_anchor must lie"),
        ({"depth_priors": DepthPriors(*np.array([[0], [0]]), np.ones(1), np.ones(2))}, "depth_priors must be equally"),
        ({"depth_priors": DepthPriors(*np.array([[150], [0]]), *np.ones((2, 1)))}, "depth_priors.anchor must lie"),
        ({"depth_priors": DepthPriors(*np.array([[0], [-1]]), *np.ones((2, 1)))}, "depth_priors.pose must lie"),
    ],
)
def test_misuse_names_the_array(change, message):
    problem = points_only(seeded_window(17, SMALL)).problem
    with pytest.raises(ValueError, match=message):
        refine_window(replace(problem, **change))


def test_results_are_reproducible_to_the_byte_and_inputs_unchanged():
    problem = seeded_window(19, SMALL).problem
    T, p = problem.T_c_w.copy(), problem.p_w.copy()
    a, b = refine_window(problem), refine_window(problem)
    for name in ("T_c_w", "p_w", "edge_inverse_depth"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
    np.testing.assert_array_equal(problem.T_c_w, T)
    np.testing.assert_array_equal(problem.p_w, p)


def test_gtsam_finds_the_same_minimum():
    pytest.importorskip("gtsam", reason="gtsam is an outside oracle and not installed")
    problem = points_only(seeded_window(20, SMALL)).problem
    cost, T_c_w = refine_with_gtsam(problem, 40)
    result = refine_window(problem, TIGHT)
    assert result.cost_after == pytest.approx(cost, rel=1e-8)
    np.testing.assert_allclose(result.T_c_w, T_c_w, atol=1e-6)
