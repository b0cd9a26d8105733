"""IMU readings along a recording's ground truth: correct ones, of known and unknown mount and clock, and faults."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from edgeslam_torch.eval.judge.simulated_telemetry import Drawn
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.synthetic.flights.courses import COURSES, flown
from edgeslam_torch.synthetic.flights.imu import ADIS16448, MPU6050, ImuErrors, mounted, simulate_imu

_KNOTS_S = 0.15
"""Of the spline through a ground truth: within 0.4 mm of motion capture and of EuRoC's, 3.4 mm of 7-Scenes', whose
noise it leaves out."""
_LATE_S = 0.03
_MOUNT = se3.inverse(se3.exp(np.array([0.05, -0.03, 0.02, 0.0, 0.0, 0.0]))) @ camera_on_body()
"""IMU in the axes of a drone's body, 6 cm from its origin."""
_GAPS, _GAP_S = 5, 0.5
_RANGE = ImuErrors(gyroscope_range_rad_s=0.5, accelerometer_range_m_s2=10.3)
"""Too small for hand-held motion."""

RECORDED = "recorded"
"""In place of a kind in a cell's name: the recording's own IMU; the seed is the frame from which it starts."""

Simulated = tuple[ImuModel, ImuReadings]


def simulated(drawn: Drawn, grade: ImuModel, offset_s: float = 0.0, errors: ImuErrors | None = None) -> Simulated:
    """Correct readings along the ground truth."""
    truth, stamps_s = drawn.truth, drawn.stamps_s
    near = (truth.stamps_s >= stamps_s[0] - 1.0) & (truth.stamps_s <= stamps_s[-1] + 1.0)
    model = mounted(grade, _MOUNT, offset_s)
    rng = np.random.default_rng([drawn.draw, 59])
    t, T_w_c = truth.stamps_s[near], truth.T_w_c[near]
    return model, simulate_imu(rng, t, T_w_c, model, errors=errors, knots_s=_KNOTS_S)


def _unknown(grade: ImuModel) -> Callable[[Drawn], Simulated]:
    """Mount and clock are not stated, and the clock is `_LATE_S` ahead."""

    def make(drawn: Drawn) -> Simulated:
        model, readings = simulated(drawn, grade, _LATE_S)
        return replace(model, T_imu_cam=None, time_offset_s=None), readings

    return make


def _spoilt(change: Callable[[ImuReadings], ImuReadings]) -> Callable[[Drawn], Simulated]:
    """Correct readings, changed by a function."""

    def make(drawn: Drawn) -> Simulated:
        model, readings = simulated(drawn, MPU6050)
        return model, change(readings)

    return make


def _with_gaps(readings: ImuReadings) -> ImuReadings:
    t = readings.stamps_s
    starts = np.linspace(t[0], t[-1], _GAPS + 2)[1:-1]
    kept = np.all((t[:, None] < starts) | (t[:, None] >= starts + _GAP_S), axis=1)
    return ImuReadings(t[kept], readings.angular_rate_rad_s[kept], readings.acceleration_m_s2[kept])


def _other_flight(drawn: Drawn) -> Simulated:
    seconds = float(drawn.stamps_s[-1] - drawn.stamps_s[0]) + 1.0
    _, flight, rng = flown(COURSES["room"], drawn.draw, seconds)
    model = mounted(MPU6050, _MOUNT)
    return model, simulate_imu(rng, flight.stamps_s + drawn.stamps_s[0], flight.T_w_c, model)


IMU_KINDS: dict[str, Callable[[Drawn], Simulated]] = {
    "adis16448": lambda drawn: simulated(drawn, ADIS16448),
    "mpu6050": lambda drawn: simulated(drawn, MPU6050),
    "adis16448_unknown": _unknown(ADIS16448),
    "mpu6050_unknown": _unknown(MPU6050),
    "gaps": _spoilt(_with_gaps),
    "clipped": lambda drawn: simulated(drawn, MPU6050, errors=_RANGE),
    "degrees": _spoilt(lambda r: replace(r, angular_rate_rad_s=np.degrees(r.angular_rate_rad_s))),
    "permuted": _spoilt(
        lambda r: ImuReadings(r.stamps_s, r.angular_rate_rad_s[:, [1, 2, 0]], r.acceleration_m_s2[:, [1, 2, 0]])
    ),
    "other_flight": _other_flight,
}
"""By the name in a cell's name; the first four are correct."""
