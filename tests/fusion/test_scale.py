import math

import numpy as np
import pytest

from edgeslam_torch.fusion.scale.log_scale import LogScale, fit_displacements, floor_segments, fuse
from edgeslam_torch.fusion.telemetry_scale import _by_steps
from edgeslam_torch.geometry.rotations import matrix_from_rpy, rotation_vector
from edgeslam_torch.types import Units


def displacements(rng, n=80, scale=2.5, noise_m=0.007, noise_map=0.0, size=0.1):
    true = size * rng.standard_normal((n, 3))
    return true / scale + noise_map * rng.standard_normal((n, 3)), true + noise_m * rng.standard_normal((n, 3))


def fit(moved_map, moved_m, sigma_map=1e-4, sigma_m=0.007, **options):
    n = len(moved_map)
    block = np.arange(n) // 10
    return fit_displacements(
        moved_map,
        moved_m,
        np.full(n, 0.5),
        np.full(n, sigma_map),
        np.full(n, sigma_m),
        block,
        options.get("alignment", 0.05),
        options.get("bias", 0.03),
        0.02,
    )


def test_exact_displacements_give_the_exact_scale(rng):
    result = fit(*displacements(rng, noise_m=0.0))
    assert math.exp(result.log_scale) == pytest.approx(2.5, rel=1e-4)


def test_error_stays_within_the_stated_sigma(rng):
    ratio = []
    for _ in range(60):
        result = fit(*displacements(rng))
        ratio.append((result.log_scale - math.log(2.5)) / result.sigma)
    assert 0.6 < np.std(ratio) < 1.4  # 60 draws: one sigma of the standard deviation is 0.09
    assert abs(np.mean(ratio)) < 0.5


def test_noise_of_both_sides_does_not_shrink_the_scale(rng):
    """Plain least squares would lose noise^2 / signal^2 = 9 % here."""
    logs, plain = [], []
    for _ in range(40):
        moved_map, moved_m = displacements(rng, n=200, noise_map=0.012)
        logs.append(fit(moved_map, moved_m, sigma_map=0.012).log_scale - math.log(2.5))
        plain.append(math.log(np.sum(moved_map * moved_m) / np.sum(moved_map**2) / 2.5))
    assert np.mean(plain) < -0.06
    assert abs(np.mean(logs)) < 0.015


def test_a_rotation_between_the_frames_is_found(rng):
    moved_map, moved_m = displacements(rng, noise_m=0.001)
    R = matrix_from_rpy(np.array([0.02, -0.03, 0.08]))
    result = fit(moved_map @ R, moved_m, sigma_m=0.001, alignment=0.5)
    assert np.linalg.norm(rotation_vector(result.rotation.T @ R)) < 0.01
    assert math.exp(result.log_scale) == pytest.approx(2.5, rel=0.01)


def test_a_drifting_velocity_bias_does_not_pull_the_scale(rng):
    moved_map, moved_m = displacements(rng, n=120, noise_m=0.002)
    bias = np.linspace(0.0, 0.1, 120)[:, None] * [1.0, -0.5, 0.2]
    result = fit(moved_map, moved_m + 0.5 * bias, sigma_m=0.002)
    assert math.exp(result.log_scale) == pytest.approx(2.5, rel=0.01)
    np.testing.assert_allclose(result.bias_m_s[-1], bias[-1], atol=0.02)


def test_a_third_of_frozen_readings_does_not_pull_the_scale(rng):
    moved_map, moved_m = displacements(rng, n=90)
    moved_m[30:60] = [0.15, 0.0, 0.0]
    assert math.exp(fit(moved_map, moved_m).log_scale) == pytest.approx(2.5, rel=0.05)


@pytest.mark.parametrize("count", [0, 3])
def test_too_few_displacements_say_nothing(rng, count):
    assert fit(*(a[:count] for a in displacements(rng))) is None


def test_no_motion_says_nothing():
    assert fit(np.zeros((30, 3)), np.zeros((30, 3))) is None


def test_a_hole_in_time_starts_a_new_segment():
    np.testing.assert_array_equal(floor_segments(np.array([0.0, 0.1, 2.0]), np.ones(3), np.ones(3), 0.1), [0, 0, 1])


def test_no_estimate_means_arbitrary_units():
    assert fuse([]).units is Units.ARBITRARY
    assert fuse([]).source == "none"


def test_fused_scale_is_the_weighted_mean_with_all_sources_named():
    fused = fuse([LogScale(0.0, 0.01, "telemetry"), LogScale(0.02, 0.02, "height"), LogScale(0.0, 0.09, "depth")])
    assert math.log(fused.value) == pytest.approx(0.004, abs=0.001)
    assert fused.source == "telemetry+height+depth"
    assert fused.units is Units.METRES
    assert fused.sigma < 0.01


def test_inconsistent_estimates_widen_sigma():
    fused = fuse([LogScale(0.0, 0.01, "telemetry"), LogScale(0.3, 0.01, "height")])
    assert fused.sigma > 0.1


@pytest.mark.parametrize(("step_m", "range_m", "error"), [(0.1, 0.4, 0.0625), (0.01, 0.4, 0.000625), (0.1, 0.0, 1.0)])
def test_heights_in_coarse_steps_err_by_the_same_at_each_pass(step_m, range_m, error):
    z = np.linspace(0.0, range_m, 200)
    assert _by_steps(np.tile(z, 5), step_m) == pytest.approx(error)


@pytest.mark.parametrize("begin", [0.0, 0.02, 0.05, 0.07])
def test_the_slope_of_a_rounded_height_is_wrong_by_no_more_than_stated(begin):
    z = np.linspace(begin, begin + 0.4, 4000)
    told = 0.1 * np.rint(10.0 * z)
    assert abs(np.polyfit(z, told, 1)[0] - 1.0) < 1.05 * _by_steps(told, 0.1)
