import numpy as np
import pytest

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.filter.delayed import BufferedEkf, PoseSigma
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import TelemetrySample

CONFIG = FusionConfig()


def telemetry(rng, count=40):
    return [
        TelemetrySample(0.1 * k, np.array([0.5, 0.1 * np.sin(0.2 * k), 0.0]), rng.normal(0, 0.003, 3), battery=0.8)
        for k in range(count)
    ]


def increments(rng, count=18):
    out = []
    for k in range(1, count):
        T = np.eye(4)
        T[:3, 3] = [0.1, 0.0, 0.0] + rng.normal(0, 0.003, 3)
        out.append((0.2 * k - 0.17, 0.2 * k + 0.03, T))
    return out


def run(samples, visual, delay):
    """Feed in order of arrival: telemetry at once, visual increments ``delay`` late."""
    ekf = BufferedEkf(CONFIG)
    arrivals = [(s.stamp_s, 0, s) for s in samples] + [(v[1] + delay, 1, v) for v in visual]
    for _, kind, item in sorted(arrivals, key=lambda a: a[:2]):
        if kind == 0:
            ekf.add_telemetry(item)
        else:
            ekf.add_relative(item[0], item[1], item[2], PoseSigma(0.004, 0.003))
    return ekf


def test_late_measurements_end_where_punctual_ones_do(rng):
    samples, visual = telemetry(rng), increments(rng)
    late, later = run(samples, visual, 0.31), run(samples, visual, 0.9)
    a, b = late.state_at(3.3), later.state_at(3.3)
    np.testing.assert_allclose(a.p_w, b.p_w, atol=2e-4)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=0.02, atol=1e-7)


def test_the_speed_of_a_wrong_map_does_not_stay_when_it_is_lost():
    """A map sinks at .7 m/s for 2 s while the drone flies level, told as .2 m/s ahead; then nothing is seen for 5 s."""
    ekf = BufferedEkf(CONFIG)
    T = np.eye(4)
    T[:3, 3] = [0.02, 0.0, -0.07]
    for k in range(70):
        ekf.add_telemetry(TelemetrySample(0.1 * k, np.array([0.2, 0.0, 0.1]), np.zeros(3), battery=1.0))
        if 0 < k <= 20:
            ekf.add_relative(0.1 * (k - 1), 0.1 * k, T, PoseSigma(0.003, 0.003))
            lost_w = ekf.state_at(0.1 * k).p_w
    moved = ekf.state_at(6.9).p_w - lost_w
    assert moved[0] == pytest.approx(0.98, abs=0.1)
    assert moved[2] > -0.1, "the map sank by .7 m/s, and may not go on with it"
    assert np.abs(ekf.state_at(6.9).velocity_bias_m_s).max() <= CONFIG.velocity_step_m_s


def test_missing_fields_are_left_out():
    ekf = BufferedEkf(CONFIG)
    ekf.add_telemetry(TelemetrySample(0.0, rpy_rad=np.array([0.0, 0.0, 0.5])))
    ekf.add_telemetry(TelemetrySample(0.1, velocity_m_s=np.array([1.0, 0.0, 0.0])))
    ekf.add_telemetry(TelemetrySample(0.2, velocity_m_s=np.array([1.0, 0.0, 0.0])))
    ekf.add_telemetry(TelemetrySample(np.nan))
    state = ekf.state_at(0.2)
    assert state.p_w[0] == pytest.approx(0.15, abs=1e-6)
    assert state.rpy_rad[2] == pytest.approx(0.5, abs=1e-6)


def test_absolute_update_pulls_towards_the_accumulated_pose(rng):
    ekf = run(telemetry(rng, 20), [], 0.0)
    here = ekf.state_at(1.9)
    T = se3.exp(np.r_[here.p_w, 0, 0, 0])
    T[:3, 3] = here.p_w + [0.02, 0.0, 0.0]
    ekf.add_absolute(1.9, T, PoseSigma(0.005, 0.01))
    assert 0.005 < ekf.state_at(1.9).p_w[0] - here.p_w[0] < 0.02


def test_what_is_older_than_the_buffer_changes_nothing(rng):
    ekf = run(telemetry(rng, 80), [], 0.0)
    before, T = ekf.state_at(7.9).p_w, se3.exp(np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    ekf.add_relative(0.1, 0.2, T, PoseSigma(0.004, 0.003))
    ekf.add_telemetry(TelemetrySample(0.15, np.array([5.0, 0.0, 0.0]), np.zeros(3), battery=0.8))
    np.testing.assert_array_equal(ekf.state_at(7.9).p_w, before)
    assert ekf.statistics()["too late"] >= 1
