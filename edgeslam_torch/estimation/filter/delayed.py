"""Late and out-of-order measurements: buffer the last seconds, insert in time order and re-propagate."""

import bisect
import math
from collections import Counter
from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.filter.ekf import Ekf, EkfState, Outcome, Relative, Saved
from edgeslam_torch.geometry.rotations import rpy_from_matrix, wrapped
from edgeslam_torch.types import FloatArray, TelemetrySample

_TELEMETRY, _RELATIVE, _ABSOLUTE, _CLONE = range(4)
_BUFFER_S = 3.0
"""Maximum age of a late measurement that is still inserted in time order."""
_SAME_S = 1e-6
_SILENCE_S = 0.5
"""Maximum gap between readings for interpolation."""
_PACKET_S = 0.15
"""Maximum time for extrapolating a rotation rate: one packet."""
_EXACT = 1e-6
"""Minimum jitter [m], [rad]: keeps the innovation covariance invertible."""


@dataclass(frozen=True, slots=True)
class PoseSigma:
    """Standard deviations of a pose or of an increment, per axis."""

    t_m: float = 0.0
    r_rad: float = 0.0


@dataclass(slots=True)
class _Event:
    stamp_s: float
    kind: int
    sample: TelemetrySample | None = None
    T: FloatArray | None = None
    from_s: float = math.nan
    noise: PoseSigma = PoseSigma()
    """Drift of an increment, error of an absolute pose."""
    jitter: PoseSigma = PoseSigma()
    saved: Saved | None = None
    clone_s: float = math.nan
    outcome: str = ""
    nis: float = math.nan
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))
    battery: float = math.nan
    rate: FloatArray = field(default_factory=lambda: np.zeros(3))
    """Of roll, pitch and yaw [rad/s], by the last two readings."""
    rpy: FloatArray | None = None
    rpy_s: float = math.nan

    def inherit(self, previous: "_Event") -> None:
        """Copy what stays valid until the next reading or clone."""
        self.clone_s, self.battery, self.rate = previous.clone_s, previous.battery, previous.rate
        self.rpy, self.rpy_s = previous.rpy, previous.rpy_s

    @property
    def key(self) -> tuple[float, int]:
        return self.stamp_s, self.kind


class BufferedEkf:
    """`Ekf` with a clock: measurements of the last three seconds may arrive in any order.

    A late measurement is inserted among the buffered events; the filter is restored to the state before it and later
    events are applied again. Velocities and angles between two readings are interpolated once both have arrived.
    """

    def __init__(self, config: FusionConfig) -> None:
        self.config = config
        self.ekf = Ekf(config)
        self._events: list[_Event] = []
        self._telemetry_s = -math.inf
        self._done: Counter[str] = Counter()
        self._nis: list[tuple[int, float]] = []

    @property
    def stamp_s(self) -> float | None:
        """Time of the newest event, ``None`` before the first."""
        return self._events[-1].stamp_s if self._events else None

    @property
    def telemetry_s(self) -> float:
        """Stamp of the newest state message, minus infinity before the first."""
        return self._telemetry_s

    def add_telemetry(self, sample: TelemetrySample) -> None:
        """Velocity (predicts up to the next reading) and attitude of one state message; NaN fields are left out."""
        if math.isfinite(sample.stamp_s):
            self._telemetry_s = max(self._telemetry_s, sample.stamp_s)
            self._insert(_Event(sample.stamp_s, _TELEMETRY, sample=sample))

    def see(self, stamp_s: float) -> None:
        """Start vision at an unmeasured pose: the origin of the increments that follow."""
        if math.isfinite(stamp_s):
            self._insert(_Event(stamp_s, _CLONE))

    def add_relative(
        self, from_s: float, to_s: float, T_from_to: FloatArray, drift: PoseSigma, jitter: PoseSigma | None = None
    ) -> None:
        """Visual motion of the body between two stamps.

        Args:
            from_s: End of the previous increment; a gap starts anew.
            to_s: End.
            T_from_to: Pose at ``to_s`` in the body frame at ``from_s`` [m], shape ``(4, 4)``.
            drift: Error of the increment, which accumulates.
            jitter: Error of the visual pose at its end, which does not.
        """
        if not math.isfinite(from_s + to_s) or to_s <= from_s:
            self._done["out of order"] += 1
            return
        before = self._go_to(to_s)
        if before is None or not abs(before.clone_s - from_s) < _SAME_S:
            self.see(from_s)
        jitter = jitter or PoseSigma()
        self._insert(_Event(to_s, _RELATIVE, T=T_from_to, from_s=from_s, noise=drift, jitter=jitter))

    def add_absolute(self, stamp_s: float, T_w_b: FloatArray, sigma: PoseSigma) -> None:
        """Accumulated visual pose of the body in the power-on world [m], paper eq. (14)."""
        if math.isfinite(stamp_s):
            self._insert(_Event(stamp_s, _ABSOLUTE, T=T_w_b, noise=sigma))

    def state_at(self, stamp_s: float) -> EkfState | None:
        """State at a stamp inside the buffer or ahead of it; ``None`` before the first event."""
        event = self._go_to(stamp_s)
        if event is None:
            return None
        present = self.ekf.copy_state()
        self._advance(event, stamp_s)
        state = self.ekf.state(stamp_s)
        self.ekf.restore(present)
        return state

    def since_visual(self, stamp_s: float) -> tuple[float, Relative] | None:
        """Stamp of the last visual pose before a stamp, and the motion of the body since; ``None`` without one."""
        event = self._go_to(stamp_s)
        if event is None or not math.isfinite(event.clone_s):
            return None
        present = self.ekf.copy_state()
        velocity = self._advance(event, stamp_s)
        moved = self.ekf.since_clone(velocity)
        self.ekf.restore(present)
        return event.clone_s, moved

    def _go_to(self, stamp_s: float) -> _Event | None:
        """Restore the filter to the last event up to a stamp."""
        index = bisect.bisect_right(self._events, (stamp_s, _CLONE + 1), key=lambda e: e.key)
        return self._events[index - 1] if index > 0 else None

    def _advance(self, event: _Event, stamp_s: float) -> FloatArray:
        """Restore the filter to an event and propagate it; returns the velocity there."""
        assert event.saved is not None
        self.ekf.restore(event.saved)
        return self._predict(event, stamp_s, bisect.bisect_right(self._events, event.key, key=lambda e: e.key))

    def resumed(self) -> "BufferedEkf":
        """An independent filter that continues from the newest event."""
        other = BufferedEkf(self.config)
        if self._events:
            other._events.append(replace(self._events[-1]))
            other._telemetry_s = self._telemetry_s
            assert other._events[0].saved is not None
            other.ekf.restore(other._events[0].saved)
        return other

    def statistics(self) -> dict[str, int]:
        """Numbers of accepted, refused, recovered and late measurements."""
        counts = Counter(self._done)
        counts.update(e.outcome for e in self._events if e.outcome)
        return dict(counts)

    def nis(self) -> list[tuple[int, float]]:
        """(degrees of freedom, normalised innovation squared) of every visual or attitude measurement so far."""
        return self._nis + [(_degrees(e), e.nis) for e in self._events if math.isfinite(e.nis)]

    def _insert(self, event: _Event) -> None:
        index = bisect.bisect_right(self._events, event.key, key=lambda e: e.key)
        if index == 0 and self._events:
            self._done["too late"] += 1
            return
        self._events.insert(index, event)
        if index > 0:
            saved = self._events[index - 1].saved
            assert saved is not None
            if index < len(self._events) - 1:
                self.ekf.restore(saved)
        else:
            self._start(event)
        for i in range(index, len(self._events)):
            self._process(i)
        self._forget()

    def _start(self, event: _Event) -> None:
        """Initialise from the first attitude or pose; the position is zero, as in the drone's own frame."""
        if event.sample is not None and np.all(np.isfinite(event.sample.rpy_rad)):
            self.ekf.reset_pose(np.zeros(3), event.sample.rpy_rad)
        elif event.kind == _ABSOLUTE and event.T is not None:
            self.ekf.reset_pose(event.T[:3, 3], rpy_from_matrix(event.T[:3, :3]))

    def _process(self, index: int) -> None:
        event, ekf = self._events[index], self.ekf
        event.outcome, event.nis = "", math.nan
        if index > 0:
            previous = self._events[index - 1]
            event.inherit(previous)
            event.velocity = self._predict(previous, event.stamp_s, index)
        if event.sample is not None:
            self._apply_telemetry(event, event.sample)
        elif event.kind == _CLONE:
            ekf.clone()
            event.clone_s = event.stamp_s
        else:
            self._apply_visual(event)
        event.saved = ekf.copy_state()

    def _predict(self, previous: _Event, stamp_s: float, index: int) -> FloatArray:
        """Propagate from the event before ``index``; velocity and angles are interpolated to the next reading.

        Returns:
            The velocity at ``stamp_s`` ``(3,)``.
        """
        dt = stamp_s - previous.stamp_s
        velocity = previous.velocity
        if dt <= 0:
            return velocity
        if self.config.literal:
            self.ekf.predict(dt, velocity, previous.battery)
            return velocity
        end = velocity
        following = self._next_reading(index)
        # The printed filter keeps a reading until the next one.
        if following is not None:
            reach = following.stamp_s - previous.stamp_s
            if reach < _SILENCE_S and math.isfinite(float(following.velocity_m_s.sum())):
                end = velocity + min(1.0, dt / reach) * (following.velocity_m_s - velocity)
            rate = _rate(previous, following)
        else:
            left_s = previous.rpy_s + _PACKET_S - previous.stamp_s if math.isfinite(previous.rpy_s) else 0.0
            rate = previous.rate * min(1.0, max(0.0, left_s) / dt)
        self.ekf.predict(dt, 0.5 * (velocity + end), previous.battery, rate)
        return end

    def _next_reading(self, index: int) -> TelemetrySample | None:
        for i in range(index, len(self._events)):
            if (sample := self._events[i].sample) is not None:
                return sample
        return None

    def _apply_telemetry(self, event: _Event, sample: TelemetrySample) -> None:
        if math.isfinite(float(sample.velocity_m_s.sum())):
            event.velocity = sample.velocity_m_s
        event.rate = _rate(event, sample)
        if math.isfinite(sample.battery):
            event.battery = sample.battery
        if math.isfinite(float(sample.rpy_rad.sum())):
            event.rpy, event.rpy_s = sample.rpy_rad, sample.stamp_s
            event.outcome = self._named("attitude", self.ekf.update_attitude(sample.rpy_rad))
            event.nis = self.ekf.nis

    def _apply_visual(self, event: _Event) -> None:
        ekf = self.ekf
        assert event.T is not None
        if event.kind == _ABSOLUTE:
            rpy = rpy_from_matrix(event.T[:3, :3])
            outcome = ekf.update_absolute(event.T[:3, 3], rpy, event.noise.t_m, event.noise.r_rad)
            ekf.clone()
        elif not abs(event.clone_s - event.from_s) < _SAME_S:
            outcome = Outcome.NO_CLONE
            ekf.clone()
        else:
            ekf.carry_clone(event.T, event.noise.t_m, event.noise.r_rad)
            outcome = ekf.update_relative(np.eye(4), max(event.jitter.t_m, _EXACT), max(event.jitter.r_rad, _EXACT))
            if outcome is Outcome.REFUSED:  # later events may still be accepted
                ekf.clone()
        event.outcome = self._named("visual", outcome)
        event.nis = ekf.nis if outcome is not Outcome.NO_CLONE else math.nan
        event.clone_s = event.stamp_s

    @staticmethod
    def _named(kind: str, outcome: Outcome) -> str:
        return f"{kind} {outcome.value}"

    def _forget(self) -> None:
        horizon = self._events[-1].stamp_s - _BUFFER_S
        keep = bisect.bisect_left(self._events, horizon, key=lambda e: e.stamp_s)
        for event in self._events[:keep]:
            if event.outcome:
                self._done[event.outcome] += 1
            if math.isfinite(event.nis):
                self._nis.append((_degrees(event), event.nis))
        del self._events[:keep]
        del self._nis[:-10_000]


def _degrees(event: _Event) -> int:
    return 3 if event.kind == _TELEMETRY else 6


def _rate(before: _Event, sample: TelemetrySample) -> FloatArray:
    """Euler angle rates [rad/s] between the last attitude reading and this one; zero across a gap."""
    dt = sample.stamp_s - before.rpy_s
    if before.rpy is None or not 0.0 < dt < _SILENCE_S or not math.isfinite(float(sample.rpy_rad.sum())):
        return np.zeros(3)
    return wrapped(sample.rpy_rad - before.rpy) / dt
