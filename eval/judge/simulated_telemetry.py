"""A Tello's state messages along a recording's ground truth: right ones, and those with a fault.

10 Hz, whole dm/s, degrees and centimetres, half a second ahead of the video, drift that grows as the battery drains.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

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
HEIGHTS = ("tof_m", "height_m", "baro_m")
"""Height fields of a sample."""

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


def _rounded(drawn: Drawn, velocities: Callable[[FloatArray], FloatArray] = np.rint) -> Samples:
    """Correct messages as sent by the drone; ``velocities`` rounds velocities in dm/s to integers."""
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


def _off(drawn: Drawn) -> Samples:
    """Nothing arrives during the outage."""
    start, end = drawn.outage_s
    return [s for s in _rounded(drawn) if not start <= s.stamp_s < end]


def _frozen(drawn: Drawn) -> Samples:
    """One message is repeated during the outage."""
    start, end = drawn.outage_s
    samples = _rounded(drawn)
    stuck = next(s for s in samples if s.stamp_s >= start)
    return [replace(stuck, stamp_s=s.stamp_s) if start <= s.stamp_s < end else s for s in samples]


def _other_flight(drawn: Drawn) -> Samples:
    """Telemetry of a simulated flight through a room."""
    seconds = float(drawn.stamps_s[-1] - drawn.stamps_s[0]) + 1.0
    world, flight, rng = flown(COURSES["room"], drawn.draw, seconds)
    floor = world.floor_below(flight.T_w_b[:, :3, 3])
    log = simulate(rng, flight.stamps_s, flight.T_w_c, flight.T_b_c, floor_m=floor)
    return replace(log, stamps_s=log.stamps_s + float(drawn.stamps_s[0])).samples()


def _random_velocities(drawn: Drawn) -> Samples:
    """Random velocities and no height; the attitude is correct."""
    from scipy.signal import lfilter  # loads half of scipy

    samples = _rounded(drawn)
    rng, none = np.random.default_rng([drawn.draw, 1]), dict.fromkeys(HEIGHTS, float("nan"))
    steps = np.sqrt(1.0 - _MEMORY**2) * _SPEED_M_S * rng.standard_normal((len(samples), 3))
    velocity = 0.1 * np.rint(10.0 * lfilter([1.0], [1.0, -_MEMORY], steps, axis=0))
    return [replace(s, velocity_m_s=v, **none) for s, v in zip(samples, velocity, strict=True)]  # type: ignore[arg-type]


def _fine(velocity_dm_s: FloatArray) -> FloatArray:
    return 0.1 * np.rint(10.0 * velocity_dm_s)


def _body(drawn: Drawn) -> Samples:
    """Velocities in body axes, declared to be in the world of power-on."""
    return [
        replace(s, velocity_m_s=0.1 * np.rint(10.0 * matrix_from_rpy(s.rpy_rad).T @ s.velocity_m_s))
        for s in _rounded(drawn, _fine)
    ]


def _spoilt(
    fields: Sequence[str],
    change: Callable[[FloatArray], FloatArray],
    axis: int | None = None,
    velocities: Callable[[FloatArray], FloatArray] = np.rint,
) -> Callable[[Drawn], Samples]:
    """Correct telemetry except for some fields, or one axis of a field, changed by a function."""

    def make(drawn: Drawn) -> Samples:
        samples = _rounded(drawn, velocities)
        for name in fields:
            values = np.array([getattr(s, name) for s in samples])
            where = slice(None) if axis is None else (slice(None), axis)
            values[where] = change(values[where])
            column = values.tolist() if values.ndim == 1 else list(values)
            samples = [replace(s, **{name: value}) for s, value in zip(samples, column, strict=True)]
        return samples

    return make


def _stuck(column: FloatArray) -> FloatArray:
    """The first reading throughout."""
    return np.full_like(column, column[0])


def _jumping(by: float) -> Callable[[FloatArray], FloatArray]:
    """A step of ``by`` in the middle."""
    return lambda column: column + by * (np.arange(len(column)) >= len(column) // 2)


KINDS: dict[str, Callable[[Drawn], Samples]] = {
    "rounded": _rounded,
    "truncated": lambda drawn: _rounded(drawn, np.trunc),
    "off": _off,
    "frozen": _frozen,
    "late": _spoilt(["stamp_s"], lambda t: t + OFF_S),
    "early": _spoilt(["stamp_s"], lambda t: t - OFF_S),
    "doubled": _spoilt(["stamp_s"], lambda t: t[0] + 2.0 * (t - t[0])),
    "other_flight": _other_flight,
    "random": _random_velocities,
    "centimetres": _spoilt(["velocity_m_s"], lambda v: 10.0 * v, velocities=_fine),
    "body": _body,
    "attitude_missing": _spoilt(["rpy_rad"], lambda column: np.full_like(column, np.nan)),
    "roll_mirrored": _spoilt(["rpy_rad"], np.negative, 0),
    "pitch_mirrored": _spoilt(["rpy_rad"], np.negative, 1),
    "yaw_stuck": _spoilt(["rpy_rad"], _stuck, 2),
    "yaw_mirrored": _spoilt(["rpy_rad"], np.negative, 2),
    "yaw_jumping": _spoilt(["rpy_rad"], _jumping(np.pi / 2), 2),
    "velocity_stuck": _spoilt(["velocity_m_s"], _stuck, 0),
    "velocity_mirrored": _spoilt(["velocity_m_s"], np.negative, 1),
    "velocity_jumping": _spoilt(["velocity_m_s"], _jumping(1.0), 0),
    "velocity_halved": _spoilt(["velocity_m_s"], lambda column: 0.5 * column),
    "heights_stuck": _spoilt(HEIGHTS, _stuck),
    "heights_mirrored": _spoilt(HEIGHTS, lambda z: 2.0 * z[0] - z),
    "heights_jumping": _spoilt(HEIGHTS, _jumping(1.0)),
}
"""By the name in a cell's name; the first two are correct."""
