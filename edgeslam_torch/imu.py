"""Readings and model of an inertial measurement unit (IMU) that is fixed to the camera.

The IMU's axes are its own (``imu``); ``T_imu_cam`` takes camera coordinates to them. Stamps are on the IMU's clock,
which is ``time_offset_s`` ahead of the images': ``t_imu = t_cam + time_offset_s``.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.types import FloatArray, Record, TelemetrySample

_RIGID = 1e-3
"""Tolerance of a rotation matrix in a file of four digits."""
_CLIPPED, _STEPS = 3, 10.0
"""Readings in a row at an axis' largest magnitude, more than so many quantisation steps above the least: the end of its
range. Noise at rest repeats its largest value, too, a few steps above the least."""


@dataclass(frozen=True, slots=True, repr=False)
class ImuReadings(Record):
    """Consecutive readings of an IMU in its own axes; float64.

    An accelerometer without a gyroscope has NaN for every angular rate.

    Raises:
        ValueError: If shapes differ, stamps do not increase, or numbers are not finite.
    """

    stamps_s: FloatArray
    """``(N,)`` on the IMU's clock [s], strictly increasing."""
    angular_rate_rad_s: FloatArray
    """``(N, 3)``."""
    acceleration_m_s2: FloatArray
    """``(N, 3)`` specific force: at rest +9.81 m/s^2 along the axis that points up."""

    def __post_init__(self) -> None:
        for name in ("stamps_s", "angular_rate_rad_s", "acceleration_m_s2"):
            object.__setattr__(self, name, np.array(getattr(self, name), dtype=np.float64))
        shapes = self.stamps_s.shape, self.angular_rate_rad_s.shape, self.acceleration_m_s2.shape
        if shapes != ((n := self.stamps_s.size,), (n, 3), (n, 3)):
            raise ValueError(f"IMU readings are (N,), (N, 3), (N, 3), got {', '.join(map(str, shapes))}")
        if not np.isfinite(self.stamps_s).all() or not (self.stamps_s[1:] > self.stamps_s[:-1]).all():
            raise ValueError("stamps of IMU readings are finite and strictly increasing")
        used = [self.acceleration_m_s2, *([self.angular_rate_rad_s] if self.has_gyroscope else [])]
        if not all(np.isfinite(values).all() for values in used):
            raise ValueError("IMU readings are finite; without a gyroscope all angular rates are NaN")

    def __len__(self) -> int:
        return len(self.stamps_s)

    @property
    def has_gyroscope(self) -> bool:
        """Whether there are angular rates."""
        return not np.isnan(self.angular_rate_rad_s).all()

    def _magnitudes(self) -> FloatArray:
        return np.abs(np.concatenate([self.angular_rate_rad_s, self.acceleration_m_s2], axis=1))

    @property
    def largest(self) -> FloatArray:
        """Largest magnitude ``(6,)`` of angular rates and accelerations."""
        return np.abs(np.concatenate([self.angular_rate_rad_s, self.acceleration_m_s2], axis=1)).max(
            axis=0, initial=0.0
        )

    @property
    def range_ends(self) -> FloatArray:
        """Largest magnitude ``(6,)`` of angular rates and accelerations at which readings are clipped; infinite where
        none are."""
        ends, values = np.full(6, np.inf), self._magnitudes()
        for axis in range(0 if self.has_gyroscope else 3, 6) if len(self) >= _CLIPPED else ():
            column, known = values[:, axis], np.unique(values[:, axis])
            first = np.flatnonzero(np.diff(column, prepend=np.nan) != 0.0)
            run, level = np.diff([*first, len(column)]), column[first]
            # Slow sensors are read several times: readings repeat below the end of the range, too.
            repeats = run[(level > 0.5 * known[-1]) & (level < known[-1])].max(initial=_CLIPPED - 1)
            wide = len(known) > 1 and known[-1] - known[0] > _STEPS * np.diff(known).min()
            if wide and run[level == known[-1]].max() > repeats:
                ends[axis] = known[-1]
        return ends

    @property
    def rate_hz(self) -> float:
        """By the median interval; NaN for fewer than two."""
        return 1.0 / float(np.median(np.diff(self.stamps_s))) if len(self) > 1 else math.nan

    def between(self, after_s: float, until_s: float) -> "ImuReadings":
        """Readings with ``after_s < stamp <= until_s``."""
        first, end = np.searchsorted(self.stamps_s, (after_s, until_s), side="right")
        rows = slice(first, max(first, end))
        return ImuReadings(self.stamps_s[rows], self.angular_rate_rad_s[rows], self.acceleration_m_s2[rows])

    @classmethod
    def joined(cls, parts: Iterable["ImuReadings"]) -> "ImuReadings":
        """All readings of parts that follow each other; of doubled and reversed stamps the later readings are left
        out."""
        parts = [part for part in parts if len(part)]
        if not parts:
            return cls(np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))
        stamps_s = np.concatenate([part.stamps_s for part in parts])
        newest_s = np.concatenate([[-np.inf], np.maximum.accumulate(stamps_s)[:-1]])
        kept = stamps_s > newest_s
        return cls(
            stamps_s[kept],
            np.concatenate([part.angular_rate_rad_s for part in parts])[kept],
            np.concatenate([part.acceleration_m_s2 for part in parts])[kept],
        )


_SENSORS, _NOISES = ("gyroscope", "accelerometer"), ("noise_density", "random_walk")
MODEL_NUMBERS = (*(f"{sensor}_{noise}" for sensor in _SENSORS for noise in _NOISES), "rate_hz")
"""Fields of `ImuModel` that are positive numbers."""


@dataclass(frozen=True, slots=True, repr=False)
class ImuModel(Record):
    """Noise of an IMU, and its mount and clock beside the camera's. None: unknown, to be estimated.

    The default noise is that of a cheap one (InvenSense MPU-6050): its data sheet's densities, 0.005 deg/s/sqrt(Hz) and
    400 ug/sqrt(Hz), times five and two for vibration, and bias walks of 0.04 deg/s and 0.04 m/s^2 in a minute.

    Raises:
        ValueError: If a number is not positive, or the mount is no rigid transform.
    """

    gyroscope_noise_density: float = 4.4e-4
    """[rad/s/sqrt(Hz)]"""
    gyroscope_random_walk: float = 1e-4
    """[rad/s^2/sqrt(Hz)]"""
    accelerometer_noise_density: float = 8e-3
    """[m/s^2/sqrt(Hz)]"""
    accelerometer_random_walk: float = 5e-3
    """[m/s^3/sqrt(Hz)]"""
    rate_hz: float = 200.0
    T_imu_cam: FloatArray | None = None
    """``(4, 4)`` camera to IMU [m]."""
    time_offset_s: float | None = None
    """``t_imu = t_cam + time_offset_s``."""
    source: str = "assumed noise of a cheap IMU"
    """Where the numbers come from, for messages."""

    def __post_init__(self) -> None:
        for name in MODEL_NUMBERS:
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} of an IMU is a positive number, got {getattr(self, name)}")
        if self.time_offset_s is not None and not math.isfinite(self.time_offset_s):
            raise ValueError(f"time_offset_s of an IMU is a finite number or None, got {self.time_offset_s}")
        if self.T_imu_cam is not None:
            T = np.array(self.T_imu_cam, dtype=np.float64)
            object.__setattr__(self, "T_imu_cam", T)
            whole = T.shape == (4, 4) and np.isfinite(T).all() and T[3].tolist() == [0, 0, 0, 1]
            R = T[:3, :3] if whole else np.zeros((3, 3))
            if not np.allclose(R @ R.T, np.eye(3), atol=_RIGID) or np.linalg.det(R) < 0:
                raise ValueError("T_imu_cam is not a rotation and translation, camera to IMU")


Reading = TelemetrySample | ImuReadings
"""What `EdgeSlam.step` takes beside a frame."""


def check_readings(readings: Sequence[Reading]) -> None:
    """Refuse what are no state messages or IMU readings.

    Raises:
        TypeError: If it is no sequence of `TelemetrySample` and `ImuReadings`.
        ValueError: If a state message has a vector of another length than 3.
    """
    if not isinstance(readings, Sequence):
        raise TypeError(f"readings are a list of TelemetrySample and ImuReadings, got {type(readings).__name__}")
    for reading in readings:
        if not isinstance(reading, Reading):
            raise TypeError(f"readings: a TelemetrySample or ImuReadings is expected, got {type(reading).__name__}")
        for name in ("velocity_m_s", "rpy_rad", "acceleration_m_s2") if isinstance(reading, TelemetrySample) else ():
            if not isinstance(value := getattr(reading, name), np.ndarray) or value.shape != (3,):
                raise ValueError(f"telemetry: {name} is an array of 3 numbers, got {np.shape(value)}")


def separated(readings: Sequence[Reading]) -> tuple[list[TelemetrySample], list[ImuReadings]]:
    """State messages and IMU readings, each in their order."""
    return [r for r in readings if isinstance(r, TelemetrySample)], [r for r in readings if isinstance(r, ImuReadings)]
