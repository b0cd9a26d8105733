"""Pose-only refinement: accuracy, robustness, reported failures."""

from dataclasses import replace

import numpy as np
import pytest
from numeric import pixels

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.pose_only import PoseConfig, PoseStatus, refine_pose
from edgeslam_torch.optim.problem import PosePrior

K = (520.0, 515.0, 320.0, 240.0)


def view(rng: np.random.Generator, n: int = 300, noise_px: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    T = se3.exp(0.2 * rng.normal(size=6))
    p_c = rng.uniform((-1.5, -1, 2), (1.5, 1, 6), (n, 3))
    uv = pixels(p_c, K) + noise_px * rng.normal(size=(n, 2))
    return T, se3.transform(se3.inverse(T), p_c), uv


def away(T: np.ndarray, rng: np.random.Generator, size: float = 0.03) -> np.ndarray:
    return se3.exp(size * rng.normal(size=6)) @ T


def error(T: np.ndarray, true: np.ndarray) -> float:
    return float(np.abs(se3.log(T @ se3.inverse(true))).max())


def test_a_noise_free_pose_is_recovered_exactly(rng):
    T, p, uv = view(rng)
    result = refine_pose(away(T, rng), p, uv, np.ones(300), K)
    assert result.status is PoseStatus.OK
    assert result.inliers.all()
    assert error(result.T_c_w, T) < 1e-6
    assert result.chi2.max() < 1e-4


@pytest.mark.parametrize("share", [0.2, 0.5])
def test_outliers_are_found(share, rng):
    T, p, uv = view(rng, 400, 1.0)
    bad = rng.random(400) < share
    uv = uv + bad[:, None] * rng.choice([-1, 1], (400, 2)) * rng.uniform(15, 80, (400, 2))
    result = refine_pose(away(T, rng), p, uv, np.ones(400), K)
    assert result.status is PoseStatus.OK
    assert error(result.T_c_w, T) < 0.006  # five sigma of 200 points at 4 m and 1 px
    assert not result.inliers[bad].any()
    assert result.inliers[~bad].mean() > 0.9


def test_covariance_matches_the_scatter():
    whitened = []
    for seed in range(100):
        rng = np.random.default_rng(seed)
        T, p, uv = view(rng, 60, 1.0)
        result = refine_pose(away(T, rng, 0.01), p, uv, np.ones(60), K, config=PoseConfig(chi2=50.0))
        xi = se3.log(result.T_c_w @ se3.inverse(T))
        whitened.append(np.linalg.solve(np.linalg.cholesky(result.covariance), xi))
    assert np.square(whitened).mean() == pytest.approx(1.0, abs=0.2)  # standard error 0.06


def test_prior_pulls_by_its_information(rng):
    T, p, uv = view(rng, 50, 1.0)
    elsewhere = away(T, rng, 0.01)
    weak = refine_pose(T, p, uv, np.ones(50), K, prior=PosePrior(0, elsewhere, 1e-3 * np.eye(6)))
    strong = refine_pose(T, p, uv, np.ones(50), K, prior=PosePrior(0, elsewhere, 1e12 * np.eye(6)))
    free = refine_pose(T, p, uv, np.ones(50), K)
    assert error(weak.T_c_w, free.T_c_w) < 1e-4
    assert error(strong.T_c_w, elsewhere) < 1e-5


def test_points_behind_are_outliers_and_do_not_break_it(rng):
    T, p, uv = view(rng, 200)
    p = p.copy()
    p[:40] = se3.transform(se3.inverse(T), se3.transform(T, p[:40]) * np.array([1, 1, -1.0]))
    result = refine_pose(away(T, rng), p, uv, np.ones(200), K)
    assert result.status is PoseStatus.OK
    assert not result.inliers[:40].any()
    assert np.isinf(result.chi2[:40]).all()
    assert error(result.T_c_w, T) < 1e-6


@pytest.mark.parametrize("n", [0, 1, 5])
def test_few_points_have_a_status(n, rng):
    T, p, uv = view(rng)
    result = refine_pose(T, p[:n], uv[:n], np.ones(n), K)
    assert result.status is PoseStatus.FEW_POINTS
    np.testing.assert_array_equal(result.T_c_w, T)
    assert result.inliers.shape == (n,)


def test_degenerate_points_have_a_status(rng):
    T, p, _ = view(rng, 40)
    p = np.repeat(p[:1], 40, 0)  # one point forty times
    result = refine_pose(T, p, pixels(se3.transform(T, p), K), np.ones(40), K)
    assert result.status is PoseStatus.DEGENERATE
    np.testing.assert_array_equal(result.T_c_w, T)


def test_non_finite_input_has_a_status(rng):
    T, p, uv = view(rng)
    uv[3, 0] = np.nan
    assert refine_pose(T, p, uv, np.ones(300), K).status is PoseStatus.NOT_FINITE


def test_all_points_behind_end_with_the_start(rng):
    T, p, uv = view(rng)
    turned = se3.exp(np.array([0, 0, 0, 0, np.pi, 0])) @ T
    result = refine_pose(turned, p, uv, np.ones(300), K)
    assert result.status is PoseStatus.FEW_POINTS
    np.testing.assert_array_equal(result.T_c_w, turned)


def test_lengths_must_agree(rng):
    T, p, uv = view(rng)
    with pytest.raises(ValueError, match="equally many"):
        refine_pose(T, p[:-1], uv, np.ones(300), K)


def test_one_iteration_has_the_status_not_converged(rng):
    T, p, uv = view(rng, 300, 1.0)
    config = replace(PoseConfig(), iterations=1, rounds=1)
    assert refine_pose(away(T, rng, 0.05), p, uv, np.ones(300), K, config=config).status is PoseStatus.NOT_CONVERGED


def test_slack_has_the_stated_covariance(rng):
    """Against Gauss-Newton with every point's full 2x2 covariance, near the solution."""
    p = rng.uniform((-1, -1, 2), (1, 1, 4), (60, 3))
    slack = rng.normal(0.0, 8.0, (60, 2))
    uv = 500 * p[:, :2] / p[:, 2:] + rng.normal(0.0, 1.0, (60, 1)) * slack + rng.normal(0.0, 0.5, (60, 2))
    result = refine_pose(
        np.eye(4),
        p,
        uv,
        np.full(60, 2.0),
        (500.0, 500.0, 0.0, 0.0),
        slack_px=slack,
        config=PoseConfig(rounds=1, robust_rounds=0, chi2=1e9, iterations=50, cost_tolerance=1e-15),
    )
    T = np.eye(4)
    for _ in range(20):
        H, g = np.zeros((6, 6)), np.zeros(6)
        for point, pixel, s in zip(p, uv, slack, strict=True):
            x, y, z = (T @ np.r_[point, 1.0])[:3]
            J_uv = 500 * np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]])
            J = J_uv @ np.hstack([np.eye(3), -se3.hat(np.array([x, y, z]))])
            W = np.linalg.inv(0.25 * np.eye(2) + np.outer(s, s))
            r = 500 * np.array([x / z, y / z]) - pixel
            H += J.T @ W @ J
            g += J.T @ W @ r
        T = se3.exp(-np.linalg.solve(H, g)) @ T
    np.testing.assert_allclose(result.T_c_w, T, atol=1e-7)
    np.testing.assert_allclose(result.covariance, np.linalg.inv(H), rtol=1e-4)
