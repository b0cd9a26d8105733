"""What whole steps of velocity leave out."""

import numpy as np
import pytest

from edgeslam_torch.estimation.sensors.velocity import remainder_gain, seen_velocity
from edgeslam_torch.estimation.telemetry.quantisation import Rounding, remainder
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.estimation.telemetry.visual_memory import Displacements, Sightings
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.types import TelemetrySample

T_B_C = camera_on_body()
WHOLE = {Rounding.NEAREST: np.rint, Rounding.TRUNCATE: np.trunc}


@pytest.mark.parametrize("rounding", list(Rounding))
@pytest.mark.parametrize("speed", [-3.3, -0.8, 0.0, 0.3, 1.0, 1.4, 6.2])
def test_remainder_is_the_mean_of_what_draws_leave_out(rng, rounding, speed):
    told = WHOLE[rounding](speed + 0.4 * rng.standard_normal(400_000))
    close = 0.005 if abs(speed) < 4.0 else 0.02  # constant from there on
    assert remainder(np.array([speed]), rounding)[0] == pytest.approx(speed - told.mean(), abs=close)


def along_x(speed_m_s, unit, yaw=0.0):
    """Telemetry and sightings of a straight flight at ``unit`` metres per map unit, the drone's nose at ``yaw``."""
    t = np.arange(0.0, 6.0, 0.1)
    nan = np.nan
    velocity = np.array([speed_m_s, 0.0, 0.0])
    track = TelemetryTrack("world", 0.35)
    rest = (nan, nan, nan, np.full(3, nan), nan)
    track.add([TelemetrySample(s, velocity, np.array([0.0, 0.0, yaw]), *rest) for s in t.tolist()])
    T = np.tile(np.eye(4), (len(t), 1, 1))
    T[:, 0, 3] = speed_m_s * t / unit
    return track, Sightings(t, T, np.full(len(t), 0.001))


@pytest.mark.parametrize("unit", [1.0, 2.5])
def test_a_truncated_flight_loses_half_a_step_on_average(unit):
    track, seen = along_x(0.72, unit)
    shown = seen_velocity(track, seen, 0.0, np.eye(3), T_B_C, 0.35)
    lost = shown.lost(np.array([1.0, 5.0]), unit, 0.1, Rounding.TRUNCATE)
    np.testing.assert_allclose(lost[1] - lost[0], [4.0 * 0.05, 0.0, 0.0], atol=0.008)


def intervals(seen):
    start, end = seen.T[:-10:5, :3, 3], seen.T[5:-5:5, :3, 3]
    n = len(start)
    turn = np.tile(np.eye(3), (n, 1, 1))
    return Displacements(seen.stamps_s[:-10:5], seen.stamps_s[5:-5:5], end - start, np.full(n, 0.001), turn, turn)


@pytest.mark.parametrize(("speed_m_s", "low", "high"), [(0.9, 0.0, 0.05), (0.02, 0.5, 0.9)])
def test_a_flight_below_one_step_confirms_any_scale(speed_m_s, low, high):
    track, seen = along_x(speed_m_s, 1.0)
    shown = seen_velocity(track, seen, 0.0, np.eye(3), T_B_C, 0.35)
    assert low <= remainder_gain(shown, intervals(seen), np.eye(3), 1.0, 0.1, Rounding.TRUNCATE) <= high
