"""A Tello's state messages along a trajectory, with units, quantisation, noise, drift and loss.

For simulated flights and for the ground truth of recordings.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.geometry import se3
from edgeslam_torch.noise import GRAVITY_M_S2
from edgeslam_torch.synthetic.flights.wind import correlated
from edgeslam_torch.types import FloatArray, TelemetrySample

FIELDS = ("vgx", "vgy", "vgz", "pitch", "roll", "yaw", "tof", "h", "baro", "bat", "agx", "agy", "agz")
"""SDK names, in the order of `TelemetryLog.rows`."""
FLIP = np.array([1.0, -1.0, -1.0])
"""x forward, y right, z down to x forward, y left, z up, and back."""
TOF_RANGE_M = (0.1, 8.0)
"""Range of the sensor: it reads 10 cm on the floor."""
_BARO_MEMORY = 0.95
"""Of the barometer's noise, from one message to the next: two seconds at 10 Hz."""
_KICK = np.sqrt(1 - _BARO_MEMORY**2)


@dataclass(frozen=True, slots=True)
class TelemetryFaults:
    """Faults of the telemetry; the defaults follow the recorded flights."""

    rate_hz: float = 10.0
    video_delay_s: float = 0.5
    """Frames are stamped this much later than telemetry of the same moment (a Tello's video is 0.3 to 0.8 s late)."""
    jitter_s: float = 0.004
    """Standard deviation of arrival times."""
    loss: float = 0.0
    """Share of packets lost."""
    velocity_noise_m_s: float = 0.03
    velocity_walk: float = 0.003
    """Random walk of the velocity bias [m/s per sqrt(s)] on a full battery."""
    bias_memory_s: float = 12.0
    """Correlation time of the bias [s]: the drone's optical flow holds it near zero."""
    battery_start: float = 0.87
    flight_time_s: float = 600.0
    """From full to empty."""
    sag: float = 2.0
    """Drift on an empty battery is ``1 + sag`` times that on a full one."""
    attitude_noise_rad: float = 0.005
    yaw_drift_rad_s: float = 0.0002
    tof_noise_m: float = 0.012
    baro_noise_m: float = 0.08
    acceleration_noise_m_s2: float = 0.15
    quantise: bool = True

    def __post_init__(self) -> None:
        if self.rate_hz <= 0 or not 0 <= self.loss < 1 or not 0 < self.battery_start <= 1:
            raise ValueError(f"rate must be positive, loss in [0, 1), battery_start in (0, 1]: {self}")


EXACT = TelemetryFaults(
    jitter_s=0.0, video_delay_s=0.0, velocity_noise_m_s=0.0, velocity_walk=0.0, attitude_noise_rad=0.0,
    yaw_drift_rad_s=0.0, tof_noise_m=0.0, baro_noise_m=0.0, acceleration_noise_m_s2=0.0, quantise=False,
)  # fmt: skip
"""No noise, no delay, no rounding."""


@dataclass(frozen=True, slots=True)
class TelemetryLog:
    """State messages in the SDK's units."""

    stamps_s: FloatArray
    """``(M,)`` arrival on the frames' clock [s]."""
    rows: FloatArray
    """``(M, 13)`` values of `FIELDS`: dm/s (x forward, y right, z down, fixed at power-on), degrees (yaw clockwise),
    cm, m, %, mg."""

    def samples(self) -> list[TelemetrySample]:
        """The same in SI units and our axes."""
        out = []
        for stamp, row in zip(self.stamps_s.tolist(), self.rows, strict=True):
            pitch, roll, yaw, tof, height, baro, battery = row[3:10].tolist()
            rpy, force = np.deg2rad([roll, -pitch, -yaw]), 1e-3 * GRAVITY_M_S2 * FLIP * row[10:]
            out.append(
                TelemetrySample(
                    stamp, 0.1 * FLIP * row[:3], rpy, 0.01 * height, 0.01 * tof, baro, force, 0.01 * battery
                )
            )
        return out

    def write(self, path: Path) -> None:
        """Write ``telemetry.csv``: ``stamp_s`` and the SDK's names; whole numbers are written as such."""
        lines = [",".join(("stamp_s", *FIELDS))]
        for stamp, row in zip(self.stamps_s, self.rows, strict=True):
            lines.append(",".join([f"{stamp:.6f}", *(f"{x:.6f}".rstrip("0").rstrip(".") for x in row)]))
        write_text(Path(path), "\n".join(lines) + "\n")


def simulate(
    rng: np.random.Generator,
    stamps_s: FloatArray,
    T_w_c: FloatArray,
    T_b_c: FloatArray,
    *,
    faults: TelemetryFaults | None = None,
    floor_m: FloatArray | float | None = None,
) -> TelemetryLog:
    """Telemetry of a drone that carries the camera along ``T_w_c``.

    The power-on frame is level, with its origin and heading those of the first pose.

    Args:
        rng: Noise.
        stamps_s: ``(F,)`` increasing frame times [s].
        T_w_c: ``(F, 4, 4)`` camera to a world whose z axis points up.
        T_b_c: ``(4, 4)`` camera to body.
        faults: Noise, rounding, delay and loss.
        floor_m: Height of the floor under each pose, ``(F,)`` or one number; None puts it 0.1 m under the lowest pose.

    Returns:
        Messages from the first frame's moment to the last one's. With a video delay they are stamped earlier than the
        frames of the same moment.

    Raises:
        ValueError: If there are fewer than four poses or the stamps do not increase.
    """
    faults = faults or TelemetryFaults()
    t = np.asarray(stamps_s, dtype=np.float64)
    if len(t) < 4 or np.any(np.diff(t) <= 0):
        raise ValueError(f"telemetry needs at least four poses with increasing stamps, got {len(t)}")
    T_w_b = np.asarray(T_w_c, dtype=np.float64) @ se3.inverse(T_b_c)
    moments = np.arange(t[0], t[-1], 1.0 / faults.rate_hz)
    path = CubicSpline(t, T_w_b[:, :3, 3])
    rotation = Slerp(t, Rotation.from_matrix(T_w_b[:, :3, :3]))(moments)
    ypr = rotation.as_euler("ZYX")
    yaw0 = float(Rotation.from_matrix(T_w_b[0, :3, :3]).as_euler("ZYX")[0])
    p_w = path(moments)
    floor = p_w[:, 2].min() - 0.1 if floor_m is None else floor_m
    if np.ndim(floor):
        floor = np.asarray(floor)[np.clip(np.searchsorted(t, moments), 0, len(t) - 1)]
    power_on = Rotation.from_euler("z", -yaw0)
    velocity = power_on.apply(_mean_velocity(path, t, moments, 1.0 / faults.rate_hz))
    battery = np.maximum(faults.battery_start - (moments - t[0]) / faults.flight_time_s, 0.0)
    velocity = velocity + _drift(rng, battery, faults) + faults.velocity_noise_m_s * rng.standard_normal(velocity.shape)
    force_b = rotation.inv().apply(_mean_acceleration(path, t, moments) + [0.0, 0.0, GRAVITY_M_S2])
    force_b = force_b + faults.acceleration_noise_m_s2 * rng.standard_normal(force_b.shape)
    yaw = ypr[:, 0] - yaw0 + faults.yaw_drift_rad_s * (moments - t[0])
    angles = np.stack([ypr[:, 2], ypr[:, 1], yaw], axis=1)
    angles = angles + faults.attitude_noise_rad * rng.standard_normal(angles.shape)
    angles = np.rad2deg((angles + np.pi) % (2 * np.pi) - np.pi)
    tof = np.clip(p_w[:, 2] - floor + faults.tof_noise_m * rng.standard_normal(len(p_w)), *TOF_RANGE_M)
    rise = p_w[:, 2] - p_w[0, 2]
    air = 100.0 + rise + correlated(_KICK * faults.baro_noise_m * rng.standard_normal(len(rise)), _BARO_MEMORY)
    turned = angles[:, [1, 0, 2]] * (-1.0, 1.0, -1.0)  # pitch, roll, yaw
    levels = [100.0 * tof, 100.0 * rise, air, 100.0 * battery]
    rows = np.column_stack([10.0 * velocity * FLIP, turned, *levels, 1e3 / GRAVITY_M_S2 * force_b * FLIP])
    if faults.quantise:
        rows = _quantised(rows)
    arrival = moments - faults.video_delay_s
    arrival = np.maximum.accumulate(arrival + faults.jitter_s * np.abs(rng.standard_normal(len(arrival))))
    kept = rng.random(len(arrival)) >= faults.loss
    return TelemetryLog(arrival[kept], rows[kept])


def _mean_velocity(path: CubicSpline, t: FloatArray, moments: FloatArray, span_s: float) -> FloatArray:
    """Displacement over ``span_s`` around each moment: summed up it gives back the path, and noise of the ground truth
    is not differentiated over less."""
    before, after = np.clip(moments - span_s / 2, t[0], t[-1]), np.clip(moments + span_s / 2, t[0], t[-1])
    return (path(after) - path(before)) / (after - before)[:, None]


def _mean_acceleration(path: CubicSpline, t: FloatArray, moments: FloatArray, span_s: float = 0.1) -> FloatArray:
    """Second difference of the path over ``2 * span_s``."""
    middle = np.clip(moments, t[0] + span_s, max(t[0] + span_s, t[-1] - span_s))
    return (path(middle + span_s) - 2 * path(middle) + path(middle - span_s)) / span_s**2


def _drift(rng: np.random.Generator, battery: FloatArray, faults: TelemetryFaults) -> FloatArray:
    """Velocity bias [m/s] in power-on axes, ``(M, 3)``: a leaky random walk that grows as the battery drains."""
    dt = 1.0 / faults.rate_hz
    kick = faults.velocity_walk * np.sqrt(dt) * (1.0 + faults.sag * (1.0 - battery))
    steps = kick[:, None] * rng.standard_normal((len(battery), 3))
    return correlated(steps, np.exp(-dt / faults.bias_memory_s))


def _quantised(rows: FloatArray) -> FloatArray:
    """Whole dm/s, degrees, cm, percent and mg; ``h`` in steps of 10 cm; baro with two decimals."""
    out = np.rint(rows)
    h, baro = FIELDS.index("h"), FIELDS.index("baro")
    out[:, h] = 10.0 * np.rint(rows[:, h] / 10.0)
    out[:, baro] = np.round(rows[:, baro], 2)
    return out + 0.0  # no minus zero
