import numpy as np
import pytest

from edgeslam_torch.estimation.sensors.height import floor_segments
from edgeslam_torch.estimation.telemetry_scale import _by_steps


def test_a_hole_in_time_starts_a_new_segment():
    np.testing.assert_array_equal(floor_segments(np.array([0.0, 0.1, 2.0]), np.ones(3), np.ones(3), 0.1), [0, 0, 1])


@pytest.mark.parametrize(("step_m", "range_m", "error"), [(0.1, 0.4, 0.0625), (0.01, 0.4, 0.000625), (0.1, 0.0, 1.0)])
def test_heights_in_coarse_steps_err_by_the_same_at_each_pass(step_m, range_m, error):
    z = np.linspace(0.0, range_m, 200)
    assert _by_steps(np.tile(z, 5), step_m) == pytest.approx(error)


@pytest.mark.parametrize("begin", [0.0, 0.02, 0.05, 0.07])
def test_the_slope_of_a_rounded_height_is_wrong_by_no_more_than_stated(begin):
    z = np.linspace(begin, begin + 0.4, 4000)
    told = 0.1 * np.rint(10.0 * z)
    assert abs(np.polyfit(z, told, 1)[0] - 1.0) < 1.05 * _by_steps(told, 0.1)
