"""A Tello's state messages along a recording's ground truth: right ones, and those with a fault.

10 Hz, whole dm/s, degrees and centimetres, half a second ahead of the video, drift that grows as the battery drains.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter

from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.geometry.rotations import matrix_from_rpy
from edgeslam_torch.synthetic.flights.courses import COURSES, flown
from edgeslam_torch.synthetic.flights.telemetry import FIELDS, TelemetryFaults, simulate
from edgeslam_torch.types import FloatArray, TelemetrySample

OUTAGE_S = 10.0
"""Length of an outage, in the middle; half of a recording that is shorter than twice this."""
OFF_S = 1.5
"""Error of stamps, beyond the maximum delay that is estimated."""
_SPEED_M_S = 0.3
"""RMS per axis of velocities that are independent of the flight."""
_MEMORY = 0.9
"""Correlation of successive readings: they decorrelate within a second, as real ones do."""

Samples = list[TelemetrySample]


@dataclass(frozen=True, slots=True)
class Drawn:
    """Ground truth and random draws for simulated telemetry."""

    truth: Trajectory
    stamps_s: FloatArray
    """``(F,)`` of the frames."""
    draw: int

    @property
    def outage_s(self) -> tuple[float, float]:
        """Start and end of the outage."""
        first, last = float(self.stamps_s[0]), float(self.stamps_s[-1])
        half = 0.5 * min(OUTAGE_S, 0.5 * (last - first))
        return 0.5 * (first + last) - half, 0.5 * (first + last) + half


def rounded(drawn: Drawn) -> Samples:
    """Correct telemetry, velocities rounded to whole dm/s."""
    return _messages(drawn)


def truncated(drawn: Drawn) -> Samples:
    """Correct telemetry, velocities truncated to whole dm/s."""
    return _messages(drawn, np.trunc)


def off(drawn: Drawn) -> Samples:
    """Nothing arrives during the outage."""
    start, end = drawn.outage_s
    return [s for s in rounded(drawn) if not start <= s.stamp_s < end]


def frozen(drawn: Drawn) -> Samples:
    """One message is repeated during the outage."""
    start, end = drawn.outage_s
    samples = rounded(drawn)
    stuck = next(s for s in samples if s.stamp_s >= start)
    return [replace(stuck, stamp_s=s.stamp_s) if start <= s.stamp_s < end else s for s in samples]


def late(drawn: Drawn) -> Samples:
    """Stamps `OFF_S` too late."""
    return [replace(s, stamp_s=s.stamp_s + OFF_S) for s in rounded(drawn)]


def early(drawn: Drawn) -> Samples:
    """Stamps `OFF_S` too early."""
    return [replace(s, stamp_s=s.stamp_s - OFF_S) for s in rounded(drawn)]


def doubled(drawn: Drawn) -> Samples:
    """A clock that runs at twice the rate."""
    samples = rounded(drawn)
    first = samples[0].stamp_s
    return [replace(s, stamp_s=first + 2.0 * (s.stamp_s - first)) for s in samples]


def other_flight(drawn: Drawn) -> Samples:
    """Telemetry of a simulated flight through a room."""
    seconds = float(drawn.stamps_s[-1] - drawn.stamps_s[0]) + 1.0
    world, flight, rng = flown(COURSES["room"], drawn.draw, seconds)
    floor = world.floor_below(flight.T_w_b[:, :3, 3])
    log = simulate(rng, flight.stamps_s, flight.T_w_c, flight.T_b_c, floor_m=floor)
    return replace(log, stamps_s=log.stamps_s + float(drawn.stamps_s[0])).samples()


def random_velocities(drawn: Drawn) -> Samples:
    """Random velocities and no height; the attitude is correct."""
    samples = rounded(drawn)
    rng = np.random.default_rng([drawn.draw, 1])
    steps = np.sqrt(1.0 - _MEMORY**2) * _SPEED_M_S * rng.standard_normal((len(samples), 3))
    velocity = 0.1 * np.rint(10.0 * lfilter([1.0], [1.0, -_MEMORY], steps, axis=0))
    nan = float("nan")
    return [
        replace(s, velocity_m_s=v, height_m=nan, tof_m=nan, baro_m=nan) for s, v in zip(samples, velocity, strict=True)
    ]


def centimetres(drawn: Drawn) -> Samples:
    """Velocities in cm/s, read as dm/s."""
    return [replace(s, velocity_m_s=10.0 * s.velocity_m_s) for s in _messages(drawn, _to_centimetres)]


def body(drawn: Drawn) -> Samples:
    """Velocities in body axes, declared to be in the world of power-on."""
    return [
        replace(s, velocity_m_s=0.1 * np.rint(10.0 * matrix_from_rpy(s.rpy_rad).T @ s.velocity_m_s))
        for s in _messages(drawn, _to_centimetres)
    ]


HEIGHTS = ("tof_m", "height_m", "baro_m")
"""Height fields of a sample."""


def missing(column: FloatArray) -> FloatArray:
    """No readings."""
    return np.full_like(column, np.nan)


def stuck(column: FloatArray) -> FloatArray:
    """The first reading throughout."""
    return np.full_like(column, column[0])


def mirrored(column: FloatArray) -> FloatArray:
    """The other sign."""
    return -column


def halved(column: FloatArray) -> FloatArray:
    """Half of it."""
    return 0.5 * column


def jumping(by: float) -> Callable[[FloatArray], FloatArray]:
    """A step of ``by`` in the middle."""
    return lambda column: (
        column + by * (np.arange(len(column)) >= len(column) // 2).reshape((-1,) + (1,) * (column.ndim - 1))
    )


def spoilt(
    fields: Sequence[str], change: Callable[[FloatArray], FloatArray], axis: int | None = None
) -> Callable[[Drawn], Samples]:
    """Correct telemetry except for some fields, or one axis of a field, changed by a function."""

    def make(drawn: Drawn) -> Samples:
        samples = rounded(drawn)
        for name in fields:
            values = np.array([getattr(s, name) for s in samples])
            where = slice(None) if axis is None else (slice(None), axis)
            values[where] = change(values[where])
            column = values.tolist() if values.ndim == 1 else list(values)
            samples = [replace(s, **{name: value}) for s, value in zip(samples, column, strict=True)]
        return samples

    return make


def _messages(drawn: Drawn, velocities: Callable[[FloatArray], FloatArray] = np.rint) -> Samples:
    """Messages as sent by the drone; ``velocities`` rounds velocities in dm/s to integers."""
    truth, stamps = drawn.truth, drawn.stamps_s
    near = (truth.stamps_s >= stamps[0] - 1.0) & (truth.stamps_s <= stamps[-1] + 1.0)
    whole, exact = (
        simulate(
            np.random.default_rng(drawn.draw),
            truth.stamps_s[near],
            truth.T_w_c[near],
            camera_on_body(),
            faults=TelemetryFaults(quantise=quantise),
        )
        for quantise in (True, False)
    )
    first, last = FIELDS.index("vgx"), FIELDS.index("vgz") + 1
    rows = whole.rows.copy()
    rows[:, first:last] = velocities(exact.rows[:, first:last]) + 0.0
    return replace(whole, rows=rows).samples()


def _to_centimetres(velocity_dm_s: FloatArray) -> FloatArray:
    return 0.1 * np.rint(10.0 * velocity_dm_s)


KINDS: dict[str, Callable[[Drawn], Samples]] = {
    "rounded": rounded,
    "truncated": truncated,
    "off": off,
    "frozen": frozen,
    "late": late,
    "early": early,
    "doubled": doubled,
    "other_flight": other_flight,
    "random": random_velocities,
    "centimetres": centimetres,
    "body": body,
    "attitude_missing": spoilt(["rpy_rad"], missing),
    "roll_mirrored": spoilt(["rpy_rad"], mirrored, 0),
    "pitch_mirrored": spoilt(["rpy_rad"], mirrored, 1),
    "yaw_stuck": spoilt(["rpy_rad"], stuck, 2),
    "yaw_mirrored": spoilt(["rpy_rad"], mirrored, 2),
    "yaw_jumping": spoilt(["rpy_rad"], jumping(np.pi / 2), 2),
    "velocity_stuck": spoilt(["velocity_m_s"], stuck, 0),
    "velocity_mirrored": spoilt(["velocity_m_s"], mirrored, 1),
    "velocity_jumping": spoilt(["velocity_m_s"], jumping(1.0), 0),
    "velocity_halved": spoilt(["velocity_m_s"], halved),
    "heights_stuck": spoilt(HEIGHTS, stuck),
    "heights_mirrored": spoilt(HEIGHTS, lambda z: 2.0 * z[0] - z),
    "heights_jumping": spoilt(HEIGHTS, jumping(1.0)),
}
"""By the name in a cell's name; the first two are correct."""
