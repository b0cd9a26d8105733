"""Late and out-of-order measurements: keep the last seconds, put each in its place and propagate again."""

import bisect
import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.ekf import Ekf, EkfState, Outcome, Saved
from edgeslam_torch.fusion.rotations import rpy_from_matrix, wrapped
from edgeslam_torch.types import FloatArray, TelemetrySample

_TELEMETRY, _RELATIVE, _ABSOLUTE, _CLONE = range(4)
_SAME_S = 1e-6
_QUANTISATION_RAD = math.radians(1.0 / math.sqrt(12.0))
_SILENCE_S = 0.5
"""Without telemetry for so long the last velocity is no longer believed."""


@dataclass(slots=True)
class _Event:
    stamp_s: float
    kind: int
    sample: TelemetrySample | None = None
    T: FloatArray | None = None
    from_s: float = math.nan
    sigma_t_m: float = 0.0
    sigma_r_rad: float = 0.0
    saved: Saved | None = None
    clone_s: float = math.nan
    outcome: str = ""
    nis: float = math.nan
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))
    battery: float = math.nan
    turn: float = 0.0
    rpy: FloatArray | None = None
    rpy_s: float = math.nan

    def inherit(self, previous: "_Event") -> None:
        """What holds until a reading or a clone says otherwise."""
        self.clone_s, self.battery, self.turn = previous.clone_s, previous.battery, previous.turn
        self.rpy, self.rpy_s = previous.rpy, previous.rpy_s

    @property
    def key(self) -> tuple[float, int]:
        return self.stamp_s, self.kind


class BufferedEkf:
    """`Ekf` with a clock: measurements of the last ``config.buffer_s`` may come in any order.

    A late one goes to its place among the kept events; the filter is restored to the state before it and everything
    behind it is applied again. Velocities between two readings are interpolated once both are there.
    """

    def __init__(self, config: FusionConfig) -> None:
        self.config = config
        self.ekf = Ekf(config)
        self._events: list[_Event] = []
        self._done: Counter[str] = Counter()
        self._nis: list[tuple[int, float]] = []

    @property
    def stamp_s(self) -> float | None:
        """Time of the newest event, ``None`` before the first."""
        return self._events[-1].stamp_s if self._events else None

    def add_telemetry(self, sample: TelemetrySample) -> None:
        """Velocity (predicts up to the next reading) and attitude of one state message; NaN fields are left out."""
        if math.isfinite(sample.stamp_s):
            self._insert(_Event(sample.stamp_s, _TELEMETRY, sample=sample))

    def add_relative(
        self, from_s: float, to_s: float, T_from_to: FloatArray, sigma_t_m: float, sigma_r_rad: float
    ) -> None:
        """Visual motion of the body between two stamps: pose at ``to_s`` in the body frame at ``from_s`` [m]."""
        if not math.isfinite(from_s + to_s) or to_s <= from_s:
            self._done["out of order"] += 1
            return
        if not any(abs(e.stamp_s - from_s) < _SAME_S and e.kind != _TELEMETRY for e in reversed(self._events)):
            self._insert(_Event(from_s, _CLONE))
        self._insert(_Event(to_s, _RELATIVE, T=T_from_to, from_s=from_s, sigma_t_m=sigma_t_m, sigma_r_rad=sigma_r_rad))

    def add_absolute(self, stamp_s: float, T_w_b: FloatArray, sigma_t_m: float, sigma_r_rad: float) -> None:
        """Accumulated visual pose of the body in the power-on world [m], paper eq. (14)."""
        if math.isfinite(stamp_s):
            self._insert(_Event(stamp_s, _ABSOLUTE, T=T_w_b, sigma_t_m=sigma_t_m, sigma_r_rad=sigma_r_rad))

    def state_at(self, stamp_s: float) -> EkfState | None:
        """State at a stamp inside the buffer or ahead of it; ``None`` before the first event."""
        index = bisect.bisect_right(self._events, (stamp_s, _CLONE + 1), key=lambda e: e.key)
        if index == 0:
            return None
        event = self._events[index - 1]
        present = self.ekf.copy_state()
        assert event.saved is not None
        self.ekf.restore(event.saved)
        self._predict(event, stamp_s, index)
        state = self.ekf.state(stamp_s)
        self.ekf.restore(present)
        return state

    def statistics(self) -> dict[str, int]:
        """How many measurements were accepted, refused, recovered, late."""
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
        """The first attitude or pose sets the state; position starts at zero, as the drone's own frame does."""
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
        """From the event before ``index`` to ``stamp_s``; velocity is interpolated towards the next reading.

        Returns:
            The velocity at ``stamp_s`` ``(3,)``.
        """
        dt = stamp_s - previous.stamp_s
        velocity, turn = previous.velocity, previous.turn
        if dt <= 0:
            return velocity
        end = velocity
        following = self._next_reading(index)
        if following is not None and not self.config.literal:
            reach = following.stamp_s - previous.stamp_s
            if reach < _SILENCE_S and math.isfinite(float(following.velocity_m_s.sum())):
                end = velocity + min(1.0, dt / reach) * (following.velocity_m_s - velocity)
            turn = _turn(previous, following)
        self.ekf.predict(dt, 0.5 * (velocity + end), previous.battery, turn)
        return end

    def _next_reading(self, index: int) -> TelemetrySample | None:
        for i in range(index, len(self._events)):
            if (sample := self._events[i].sample) is not None:
                return sample
        return None

    def _apply_telemetry(self, event: _Event, sample: TelemetrySample) -> None:
        if math.isfinite(float(sample.velocity_m_s.sum())):
            event.velocity = sample.velocity_m_s
        event.turn = _turn(event, sample)
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
            outcome = ekf.update_absolute(event.T[:3, 3], rpy, event.sigma_t_m, event.sigma_r_rad)
        elif not abs(event.clone_s - event.from_s) < _SAME_S:
            outcome = Outcome.NO_CLONE
        else:
            outcome = ekf.update_relative(event.T, event.sigma_t_m, event.sigma_r_rad)
        event.outcome = self._named("visual", outcome)
        event.nis = ekf.nis if outcome is not Outcome.NO_CLONE else math.nan
        ekf.clone()
        event.clone_s = event.stamp_s

    @staticmethod
    def _named(kind: str, outcome: Outcome) -> str:
        return f"{kind} {outcome.value}"

    def _forget(self) -> None:
        horizon = self._events[-1].stamp_s - self.config.buffer_s
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


def _turn(before: _Event, sample: TelemetrySample) -> float:
    """Turning rate [rad/s] between the last attitude reading and this one; what it was when either is missing."""
    dt = sample.stamp_s - before.rpy_s
    if before.rpy is None or not dt > 0 or not math.isfinite(float(sample.rpy_rad.sum())):
        return before.turn
    turned = wrapped(sample.rpy_rad - before.rpy)
    # Six readings' noise is in the sum; what is left is turning.
    squared = float(turned @ turned) - 6.0 * _QUANTISATION_RAD**2
    return min(math.sqrt(max(squared, 0.0)) / dt, 10.0)
