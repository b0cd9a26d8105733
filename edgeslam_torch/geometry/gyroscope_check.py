"""Does a gyroscope turn with the images? Degrees, permuted axes, an inverted mount, another flight's readings."""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from edgeslam_torch.geometry.rotations import fitted_rotation, vectors_from_matrices
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.types import FloatArray

_STEP_S = 0.2
"""Interval of the compared rotations: of a flight, 20 times the noise of a visual rotation."""
_FEWEST = 15
_LEAST_RAD = 0.01
"""RMS rotation in an interval from which on noise and bias decide nothing."""
_FITS, _APART = 0.35, 0.6
"""Relative misfit of readings that turn with the images, and of another hypothesis relative to what was stated."""
_DEGREES = 180.0 / np.pi
_SIGNED_AXES = [
    np.array(signs)[:, None] * np.eye(3)[list(order)]
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
]


@dataclass(frozen=True, slots=True)
class GyroscopeCheck:
    """Comparison of gyroscope and images."""

    fault: str = ""
    """In one line; empty if they agree, or with too little rotation to decide."""
    known: bool = False
    """Whether there was enough rotation to decide."""
    misfit: float = float("nan")
    """RMS difference of the rotations relative to their size, with the stated units and mount (or the best one, if
    none is stated)."""


def checked_against_rotation(
    readings: ImuReadings, model: ImuModel, stamps_s: FloatArray, R_w_c: FloatArray
) -> GyroscopeCheck:
    """Compare integrated angular rates with rotations of the camera.

    Args:
        readings: Of a gyroscope.
        model: Mount and clock, as stated or estimated; any mount fits when none is.
        stamps_s: ``(N,)`` of frames [s].
        R_w_c: ``(N, 3, 3)`` their orientations by vision alone.
    """
    gyroscope, camera, dt = _increments(readings, model.time_offset_s or 0.0, stamps_s, R_w_c)
    size = float(np.sqrt(np.mean(np.sum(camera**2, axis=1)))) if len(camera) else 0.0
    if len(camera) < _FEWEST or size < _LEAST_RAD:
        return GyroscopeCheck()
    if model.T_imu_cam is None:
        mounts = {"": _fitted(gyroscope, camera)}
    else:
        R = model.T_imu_cam[:3, :3]
        mounts = {"": R, "T_imu_cam is inverted: it takes camera coordinates to the IMU's": R.T}
        for axes in _SIGNED_AXES[1:]:
            words = ", ".join(
                "{}{}".format("-" if row.sum() < 0 else "", "xyz"[int(np.abs(row).argmax())]) for row in axes
            )
            mounts[f"the gyroscope's axes are not those of T_imu_cam: its x, y, z are {words} there"] = axes @ R
    tried = {
        (words, unit): _misfit(gyroscope / unit, camera @ mount.T, dt)
        for unit in (1.0, _DEGREES)
        for words, mount in mounts.items()
    }
    stated = tried["", 1.0]
    (words, unit), best = min(tried.items(), key=lambda item: item[1])
    if stated < _FITS:
        return GyroscopeCheck("", True, stated)
    if best < _FITS and best < _APART * stated:
        faults = [words] if words else []
        faults += ["the gyroscope's readings are in degrees: name their columns [deg/s]"] if unit > 1.0 else []
        return GyroscopeCheck("; ".join(faults), True, stated)
    fault = "gyroscope and images do not turn together: readings of another flight, or of a clock that is off"
    return GyroscopeCheck(fault, True, stated)


def _increments(
    readings: ImuReadings, offset_s: float, stamps_s: FloatArray, R_w_c: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotation vectors ``(M, 3)`` of gyroscope and camera, each in its own axes, over intervals ``(M,)`` of about
    `_STEP_S` within the readings."""
    t_imu, rate = readings.stamps_s - offset_s, readings.angular_rate_rad_s
    chosen, last_s = [], -np.inf
    for i in np.flatnonzero((stamps_s >= t_imu[0]) & (stamps_s <= t_imu[-1])).tolist():
        if stamps_s[i] - last_s >= _STEP_S:
            chosen.append(i)
            last_s = stamps_s[i]
    if len(chosen) < 2:
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    t, R = stamps_s[chosen], R_w_c[chosen]
    turned = np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t_imu)[:, None], axis=0)
    turned = np.vstack([np.zeros(3), turned])
    angle = np.column_stack([np.interp(t, t_imu, column) for column in turned.T])
    near = np.diff(t) < 2.0 * _STEP_S
    relative = np.swapaxes(R[:-1], 1, 2) @ R[1:]
    return np.diff(angle, axis=0)[near], vectors_from_matrices(relative)[near], np.diff(t)[near]


def _misfit(gyroscope: FloatArray, camera: FloatArray, dt: FloatArray) -> float:
    """RMS difference relative to the camera's rotations, a constant bias removed."""
    off = gyroscope - camera
    bias = (dt[:, None] * off).sum(axis=0) / float((dt**2).sum())
    left = off - dt[:, None] * np.clip(bias, -0.1, 0.1)  # beyond, it is no bias [rad/s]
    return float(np.sqrt(np.mean(left**2) / np.mean(camera**2)))


def _fitted(gyroscope: FloatArray, camera: FloatArray) -> FloatArray:
    """Rotation from camera to IMU axes that fits best (Wahba)."""
    return fitted_rotation(camera - camera.mean(axis=0), gyroscope - gyroscope.mean(axis=0))  # without bias
