"""The scale of the last seconds, and when it leaves no room for that of the flight before."""

import math

import numpy as np
import pytest

from edgeslam_torch.estimation.scale.consensus import at_odds
from edgeslam_torch.estimation.scale.log_scale import LogScale
from edgeslam_torch.estimation.scale.windowed_scale import Parted, has_changed, present_scale


def flown(count=4, speed=0.5, metres_per_unit=2.0, noise=0.0, seed=0):
    """Ways of a straight flight in seconds: what the images saw, what telemetry told, durations."""
    rng = np.random.default_rng(seed)
    moved_m = np.tile([speed, 0.0, 0.0], (count, 1)) + noise * rng.standard_normal((count, 3))
    return moved_m / metres_per_unit, moved_m, np.ones(count)


def test_windowed_scale_is_the_ratio_of_displacements():
    found = present_scale(*flown(metres_per_unit=2.0), 0.1)
    assert math.exp(found.log_scale) == pytest.approx(2.0)
    assert found.sigma == pytest.approx(math.hypot(0.05, 0.4 * 0.1 / 0.5))


def test_windowed_sigma_covers_quantisation():
    """Truncated to a decimetre a second, at speeds from .3 to .8 m/s: within two sigmas in 95 %."""
    rng = np.random.default_rng(1)
    inside = []
    for _ in range(400):
        speed = rng.uniform(0.3, 0.8)
        seen, _, duration = flown(speed=speed)
        rounding = np.floor if rng.random() < 0.5 else np.rint
        told = rounding(seen * 2.0 * 10 + 1e-9) / 10
        found = present_scale(seen, told, duration, 0.1)
        inside.append(abs(found.log_scale - math.log(2.0)) < 2 * found.sigma)
    assert np.mean(inside) > 0.95


def test_short_displacement_gives_no_scale():
    assert present_scale(*flown(count=2), 0.1) is None
    assert present_scale(*flown(speed=0.1), 0.1) is None


def test_inconsistent_directions_give_no_scale():
    seen, told, duration = flown()
    assert present_scale(seen[:, [1, 0, 2]], told, duration, 0.1) is None
    assert present_scale(-seen, told, duration, 0.1) is None


def test_only_contradictions_count_as_scale_change():
    before = LogScale(0.0, 0.03, "height")
    assert at_odds(LogScale(math.log(4.0), 0.1, "telemetry"), before)
    assert not at_odds(LogScale(math.log(1.4), 0.01, "telemetry"), before)  # a usual drift
    assert not at_odds(LogScale(math.log(1.7), 0.2, "telemetry"), before)  # not sure


def test_warning_names_both_scales():
    said = Parted(LogScale(math.log(2.0), 0.1, "telemetry"), LogScale(math.log(0.5), 0.03, "height")).warning()
    assert "2 metres per unit" in said and "0.5 by the flight before" in said


def test_wrong_unit_is_no_scale_change():
    now = present_scale(*flown(metres_per_unit=2.0), 0.1)
    seen, told, _ = flown(count=10, metres_per_unit=2.0)
    assert not has_changed(now, seen, told)
    seen, told, _ = flown(count=10, metres_per_unit=0.5)
    assert has_changed(now, seen, told)
    assert not has_changed(now, seen[:0], told[:0])  # nothing before
