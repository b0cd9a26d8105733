import math

import numpy as np
import pytest

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.filter.ekf import RECOVERS_AFTER, Ekf, Outcome
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import (
    euler_rate_matrix,
    matrix_from_rpy,
    mean_rotation,
    rotation_vector,
    wrapped,
)
from edgeslam_torch.noise import ATTITUDE_RAD

CONFIG = FusionConfig()


def pose(p, rpy):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = matrix_from_rpy(np.array(rpy)), p
    return T


def test_euler_rates_match_a_numeric_derivative(rng):
    rpy, step = rng.uniform(-1, 1, 3), 1e-6
    for k in range(3):
        moved = rpy + step * np.eye(3)[k]
        turn = rotation_vector(matrix_from_rpy(moved) @ matrix_from_rpy(rpy).T) / step
        np.testing.assert_allclose(euler_rate_matrix(rpy)[:, k], turn, atol=1e-5)


def test_mean_of_rotations_around_one_is_that_one(rng):
    R = matrix_from_rpy(np.array([0.1, -0.4, 2.0]))
    around = np.array([R @ se3.exp(np.r_[0, 0, 0, v])[:3, :3] for v in rng.normal(0, 0.05, (400, 3))])
    assert np.linalg.norm(rotation_vector(mean_rotation(around).T @ R)) < 0.01


def test_literal_process_noise_is_paper_equation_10_by_hand():
    config = FusionConfig(literal=True, literal_beta=0.01, lambda_tau=0.5)
    ekf = Ekf(config)
    ekf.P[:] = 0.0
    ekf.predict(0.1, np.zeros(3), battery=0.6)  # beta (1 - b + lambda tau) = 0.01 (0.4 + 0.05)
    np.testing.assert_allclose(ekf.covariance, 0.0045 * np.eye(6), atol=1e-15)


def test_process_noise_grows_with_time_step_spent_battery_and_blind_time():
    def variance(steps, dt, battery):
        ekf = Ekf(CONFIG)
        for _ in range(steps):
            ekf.predict(dt, np.zeros(3), battery)
        return ekf.P[0, 0] - CONFIG.sigma_bias_m_s**2 * (steps * dt) ** 2

    assert variance(1, 0.2, 1.0) > 1.5 * variance(1, 0.1, 1.0)
    assert variance(1, 0.1, 0.2) > 1.4 * variance(1, 0.1, 1.0)
    assert variance(40, 0.1, 1.0) > 1.3 * 40 * variance(1, 0.1, 1.0)


def test_relative_measurement_moves_the_state_the_shortest_way_onto_itself(rng):
    """Without noise and with equal variances the step is ``H^T (H H^T)^-1 r``, whatever the residual's coordinates."""
    x = np.r_[
        rng.normal(0, 1, 3), rng.uniform(-0.6, 0.6, 3), np.zeros(3), rng.normal(0, 1, 3), rng.uniform(-0.6, 0.6, 3)
    ]
    T = se3.inverse(pose(x[9:12], x[12:15])) @ pose(x[:3], x[3:6])

    def residual(state):
        seen = se3.inverse(pose(state[9:12], state[12:15])) @ pose(state[:3], state[3:6])
        return se3.log(se3.inverse(T) @ seen)

    H = np.array([(residual(x + 1e-6 * e) - residual(x - 1e-6 * e)) / 2e-6 for e in np.eye(15)]).T
    for _ in range(20):
        off = 1e-4 * rng.normal(size=15)
        ekf = Ekf(CONFIG)
        ekf.x, ekf.P = x + off, np.eye(15)
        assert ekf.update_relative(T, 1e-6, 1e-6) is Outcome.ACCEPTED
        step = -H.T @ np.linalg.solve(H @ H.T, H @ off)
        np.testing.assert_allclose(ekf.x - x - off, step, atol=3e-6)


CHI2_95 = {3: 7.815, 6: 12.592}
"""95 % quantiles of chi-square, from tables."""


@pytest.mark.parametrize("degrees", [3, 6])
@pytest.mark.parametrize(("share", "outcome"), [(0.97, Outcome.ACCEPTED), (1.03, Outcome.REFUSED)])
def test_gate_is_the_95_percent_quantile(degrees, share, outcome):
    """One attitude, or one pose, whose innovation is a little within or a little beyond that ellipsoid."""
    ekf = Ekf(CONFIG)
    ekf.predict(0.5, np.zeros(3))
    P = ekf.covariance
    if degrees == 3:
        sigma = math.sqrt(P[3, 3] + ATTITUDE_RAD**2)
        told = ekf.update_attitude(np.array([math.sqrt(share * CHI2_95[3]) * sigma, 0.0, 0.0]))
    else:
        sigma = math.sqrt(P[0, 0] + 0.05**2)
        told = ekf.update_absolute(np.array([math.sqrt(share * CHI2_95[6]) * sigma, 0.0, 0.0]), np.zeros(3), 0.05, 0.02)
    assert told is outcome


@pytest.mark.parametrize(
    "wrong",
    [
        {"velocity_step_m_s": 0.0},
        {"beta": -1.0},
        {"delay_range_s": (1.0, 0.0)},
        {"velocity_frame": "camera"},
    ],
)
def test_settings_out_of_range_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        FusionConfig(**wrong)


def test_recovering_for_ever_leaves_a_covariance(rng):
    """A map that goes its own way, refused and taken in again and again: the absolute place is measured by nothing, and
    must not become so unknown that what is known of the last second drowns in rounding (a flight ended so)."""
    ekf = Ekf(CONFIG)
    recovered = 0
    for _ in range(600):
        ekf.clone()
        for _ in range(3):
            ekf.predict(0.03, rng.normal(0.0, 0.2, 3))
        moved = pose(rng.normal(0.0, 0.5, 3), rng.normal(0.0, 0.2, 3))
        recovered += ekf.update_relative(moved, 0.005, 0.003) is Outcome.RECOVERED
        recovered += ekf.update_attitude(rng.normal(0.0, 0.5, 3)) is Outcome.RECOVERED
        assert np.diag(ekf.since_clone().covariance).min() > 0.0
    assert recovered > 50
    assert np.diag(ekf.P).max() < 1e6
    eigenvalues = np.linalg.eigvalsh(ekf.P)
    assert eigenvalues[0] > -1e-12 * eigenvalues[-1]


@pytest.mark.parametrize(("frame", "moved"), [("world", [0.5, 0.0, 0.1]), ("body", [0.0, 0.5, 0.1])])
def test_velocity_moves_the_position_as_paper_equation_9_says(frame, moved):
    ekf = Ekf(FusionConfig(velocity_frame=frame))
    ekf.reset_pose(np.zeros(3), np.array([0.0, 0.0, math.pi / 2]))
    ekf.predict(0.5, np.array([1.0, 0.0, 0.2]))
    np.testing.assert_allclose(ekf.p_w, moved, atol=1e-12)


@pytest.mark.parametrize(("literal", "off_rad"), [(False, 0.02), (True, math.pi)])
def test_angle_innovation_wraps_across_pi_but_for_the_printed_filter(literal, off_rad):
    ekf = Ekf(FusionConfig(literal=literal))
    ekf.reset_pose(np.zeros(3), np.array([0.0, 0.0, math.pi - 0.01]))
    assert ekf.update_attitude(np.array([0.0, 0.0, -math.pi + 0.01])) is Outcome.ACCEPTED
    off = abs(wrapped(ekf.rpy_rad[2] - math.pi))
    assert off < 0.02 if not literal else 0.5 < off < off_rad


def test_gate_refuses_a_jump_and_recovers_when_it_stays():
    """What is refused, or is no number, changes nothing."""
    ekf = Ekf(CONFIG)
    before, wrong = ekf.copy(), np.array([0.0, 0.0, 0.8])
    assert ekf.update_attitude(np.array([0.0, np.nan, 0.0])) is Outcome.NOT_FINITE
    outcomes = [ekf.update_attitude(wrong) for _ in range(RECOVERS_AFTER - 1)]
    assert outcomes == [Outcome.REFUSED] * (RECOVERS_AFTER - 1)
    np.testing.assert_array_equal(ekf.x, before.x)
    np.testing.assert_array_equal(ekf.P, before.P)
    assert ekf.update_attitude(wrong) is Outcome.RECOVERED
    assert abs(ekf.rpy_rad[2] - 0.8) < 0.1
