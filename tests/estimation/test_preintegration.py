"""Pre-integration against gtsam's, exact motion, and finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.estimation.inertial.preintegration import Preintegrated, preintegrate
from edgeslam_torch.imu import ImuModel, ImuReadings

STAMPS_S = np.arange(0.0, 1.2, 0.005)
RATE = np.stack([np.sin(3.0 * STAMPS_S + k) for k in range(3)], axis=1)
FORCE = np.stack([2.0 * np.cos(2.0 * STAMPS_S + k) for k in range(3)], axis=1) + [0.0, 0.0, 9.81]
BIAS = np.array([0.01, -0.02, 0.03, 0.1, 0.2, -0.1])
EDGES_S = np.array([0.1, 0.3512, 0.6037, 0.9])
NOISE = (1.7e-4, 2e-3)
MODEL = ImuModel(gyroscope_noise_density=NOISE[0], accelerometer_noise_density=NOISE[1])


def found(bias: np.ndarray = BIAS, edges_s: np.ndarray = EDGES_S) -> Preintegrated:
    return preintegrate(ImuReadings(STAMPS_S, RATE, FORCE), edges_s, bias, MODEL)


@pytest.mark.parametrize("k", range(3))
def test_increments_and_covariance_are_those_of_gtsam(k: int) -> None:
    gtsam = pytest.importorskip("gtsam", reason="gtsam is an outside oracle and not installed")
    params = gtsam.PreintegrationParams.MakeSharedU(9.81)
    params.setGyroscopeCovariance(NOISE[0] ** 2 * np.eye(3))
    params.setAccelerometerCovariance(NOISE[1] ** 2 * np.eye(3))
    params.setIntegrationCovariance(np.zeros((3, 3)))
    theirs = gtsam.PreintegratedImuMeasurements(params, gtsam.imuBias.ConstantBias(BIAS[3:], BIAS[:3]))
    start, end = EDGES_S[k : k + 2]
    moments = np.concatenate([[start], np.extract((start < STAMPS_S) & (end > STAMPS_S), STAMPS_S), [end]])
    for since, until in zip(moments[:-1], moments[1:], strict=True):
        rate, force = (
            np.array([np.interp(0.5 * (since + until), STAMPS_S, values[:, i]) for i in range(3)])
            for values in (RATE, FORCE)
        )
        dt = (until - since) / 50  # gtsam adds rotation vectors, and rotates the acceleration at a step's start
        middle = Rotation.from_rotvec(0.5 * dt * (rate - BIAS[:3]))
        for _ in range(50):
            theirs.integrateMeasurement(middle.apply(force - BIAS[3:]) + BIAS[3:], rate, dt)
    ours = found()
    np.testing.assert_allclose(ours.R[k], theirs.deltaRij().matrix(), atol=1e-5)
    np.testing.assert_allclose(ours.v[k], theirs.deltaVij(), atol=1e-5)
    np.testing.assert_allclose(ours.p[k], theirs.deltaPij(), atol=1e-5)
    order = [0, 1, 2, 6, 7, 8, 3, 4, 5]  # theirs: rotation, position, velocity
    sigma = np.sqrt(np.diag(ours.covariance[k]))
    apart = ours.covariance[k] - theirs.preintMeasCov()[np.ix_(order, order)]
    np.testing.assert_allclose(apart / np.outer(sigma, sigma), 0.0, atol=0.02)


def test_increments_of_exact_motion() -> None:
    """A turn on a circle: constant readings have an increment in closed form."""
    rate, radius, seconds = 1.5, 2.0, 0.8
    force = np.array([-radius * rate**2, 0.0, 0.0])  # towards the centre, in axes that turn along
    ones = np.ones((len(STAMPS_S), 1))
    readings = ImuReadings(STAMPS_S, ones * [0.0, 0.0, rate], ones * force)
    ours = preintegrate(readings, np.array([0.1, 0.1 + seconds]), np.zeros(6), MODEL)
    angle = rate * seconds
    np.testing.assert_allclose(Rotation.from_matrix(ours.R[0]).as_rotvec(), [0.0, 0.0, angle], atol=1e-12)
    speed = radius * rate
    np.testing.assert_allclose(ours.v[0], [-speed * np.sin(angle), speed * (np.cos(angle) - 1.0), 0.0], atol=2e-5)
    p = [radius * (np.cos(angle) - 1.0), radius * np.sin(angle) - speed * seconds, 0.0]
    np.testing.assert_allclose(ours.p[0], p, atol=2e-5)


@pytest.mark.parametrize("component", range(6))
def test_derivatives_by_the_bias(component: int) -> None:
    step = np.zeros(6)
    step[component] = 1e-5
    more, less = found(BIAS + step), found(BIAS - step)
    turned = Rotation.from_matrix(np.swapaxes(less.R, 1, 2) @ more.R).as_rotvec()
    numeric = np.concatenate([turned, more.v - less.v, more.p - less.p], axis=1) / 2e-5
    np.testing.assert_allclose(found().by_bias[:, :, component], numeric, atol=1e-8)


@pytest.mark.parametrize(
    ("edges_s", "complete"), [([0.1, 0.2], True), ([-0.1, 0.2], False), ([1.0, 1.3], False), ([0.4, 0.6], False)]
)
def test_intervals_without_readings_are_told(edges_s: list[float], complete: bool) -> None:
    there = (STAMPS_S < 0.45) | (STAMPS_S > 0.55)
    ours = preintegrate(ImuReadings(STAMPS_S[there], RATE[there], FORCE[there]), np.array(edges_s), BIAS, MODEL)
    assert ours.complete.tolist() == [complete]


def test_an_interval_with_clipped_readings_is_unknown() -> None:
    readings = ImuReadings(STAMPS_S, RATE, np.clip(FORCE, -1.9, [1.9, 1.9, 8.5]))
    ends = readings.range_ends
    assert np.isfinite(ends[3:]).tolist() == [True, True, True]
    assert not np.isfinite(ends[:3]).any()
    edges_s = np.arange(0.052, 1.15, 0.05)
    clipped = STAMPS_S[(np.abs(FORCE) >= ends[3:]).any(axis=1)]
    free = [
        not ((clipped > a - 0.005) & (clipped < b + 0.005)).any()
        for a, b in zip(edges_s[:-1] - 1e-9, edges_s[1:] + 1e-9, strict=True)
    ]
    assert 0 < sum(free) < len(free)
    assert preintegrate(readings, edges_s, BIAS, MODEL, ends).complete.tolist() == free


def test_noise_at_rest_is_not_clipped() -> None:
    rng = np.random.default_rng(0)
    still = [0.1 * np.rint(rng.standard_normal((500, 3))), 9.8 + 0.1 * np.rint(rng.standard_normal((500, 3)))]
    assert not np.isfinite(ImuReadings(0.005 * np.arange(500.0), *still).range_ends).any()
