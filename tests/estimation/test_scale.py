import math

import numpy as np
import pytest

from edgeslam_torch.estimation.scale.log_scale import LogScale, fuse
from edgeslam_torch.estimation.sensors.height import floor_segments
from edgeslam_torch.estimation.telemetry_scale import _by_steps
from edgeslam_torch.types import Units


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
