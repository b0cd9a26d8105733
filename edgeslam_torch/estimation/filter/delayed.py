"""Late and out-of-order measurements: buffer the last seconds, insert in time order and re-propagate."""

import bisect
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.filter.ekf import Ekf, Outcome, Relative
from edgeslam_torch.geometry.rotations import rpy_from_matrix, wrapped
from edgeslam_torch.types import FloatArray, TelemetrySample

_TELEMETRY, _VISUAL, _CLONE = range(3)
"""Order of events with the same stamp."""
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
    key: tuple[float, int]
    """Stamp and kind."""
    apply: Callable[[Ekf], str]
    """Applies the measurement and names the outcome, empty if there is none."""
    sample: TelemetrySample | None = None
    start: tuple[FloatArray, FloatArray] | None = None
    """Position and angles ``(3,)`` each of a flight that begins with this event; None if it does not tell them."""
    after: Ekf | None = None
    """The filter after the event."""
    outcome: str = ""


class BufferedEkf:
    """`Ekf` with a clock: measurements of the last three seconds may arrive in any order.

    A late measurement is inserted among the buffered events, and later events are applied again. Velocities and angles
    between two readings are interpolated once both have arrived.
    """

    def __init__(self, config: FusionConfig) -> None:
        self.config = config
        self._events: list[_Event] = []
        self.telemetry_s = -math.inf
        """Stamp of the newest state message."""
        self._done: Counter[str] = Counter()

    @property
    def stamp_s(self) -> float | None:
        """Time of the newest event, ``None`` before the first."""
        return self._events[-1].key[0] if self._events else None

    def add_telemetry(self, sample: TelemetrySample, ranged: bool = False) -> None:
        """Velocity (predicts up to the next reading) and attitude of one state message; NaN fields are left out.

        ``ranged``: heights gave the vertical velocity.
        """
        if math.isfinite(sample.stamp_s):
            self.telemetry_s = max(self.telemetry_s, sample.stamp_s)
            start = (np.zeros(3), sample.rpy_rad) if np.isfinite(sample.rpy_rad).all() else None
            self._insert(_Event((sample.stamp_s, _TELEMETRY), lambda ekf: _read(ekf, sample, ranged), sample, start))

    def see(self, stamp_s: float) -> None:
        """Start vision at an unmeasured pose: the origin of the increments that follow."""

        def clone(ekf: Ekf) -> str:
            ekf.clone()
            ekf.clone_s = stamp_s
            return ""

        if math.isfinite(stamp_s):
            self._insert(_Event((stamp_s, _CLONE), clone))

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
        noise = jitter or PoseSigma()

        def moved(ekf: Ekf) -> str:
            if not abs(ekf.clone_s - from_s) < _SAME_S:
                outcome = Outcome.NO_CLONE
            else:
                ekf.carry_clone(T_from_to, drift.t_m, drift.r_rad)
                outcome = ekf.update_relative(np.eye(4), max(noise.t_m, _EXACT), max(noise.r_rad, _EXACT))
            if outcome in (Outcome.NO_CLONE, Outcome.REFUSED):  # later events may still be accepted
                ekf.clone()
            ekf.clone_s = to_s
            return f"visual {outcome.value}"

        if not math.isfinite(from_s + to_s) or to_s <= from_s:
            self._done["out of order"] += 1
            return
        before = self._events[self._count_until(to_s) - 1].after if self._count_until(to_s) else None
        if before is None or not abs(before.clone_s - from_s) < _SAME_S:
            self.see(from_s)
        self._insert(_Event((to_s, _VISUAL), moved))

    def add_absolute(self, stamp_s: float, T_w_b: FloatArray, sigma: PoseSigma) -> None:
        """Accumulated visual pose of the body in the power-on world [m], paper eq. (14)."""

        pose = T_w_b[:3, 3], rpy_from_matrix(T_w_b[:3, :3])

        def placed(ekf: Ekf) -> str:
            outcome = ekf.update_absolute(*pose, sigma.t_m, sigma.r_rad)
            ekf.clone()
            ekf.clone_s = stamp_s
            return f"visual {outcome.value}"

        if math.isfinite(stamp_s):
            self._insert(_Event((stamp_s, _VISUAL), placed, start=pose))

    def state_at(self, stamp_s: float) -> Ekf | None:
        """The filter at a stamp inside the buffer or ahead of it; ``None`` before the first event."""
        return self._at(stamp_s, self._count_until(stamp_s))

    def since_visual(self, stamp_s: float) -> tuple[float, Relative] | None:
        """Stamp of the last visual pose before a stamp, and the motion of the body since; ``None`` without one."""
        ekf = self.state_at(stamp_s)
        return None if ekf is None or not math.isfinite(ekf.clone_s) else (ekf.clone_s, ekf.since_clone())

    def resumed(self) -> "BufferedEkf":
        """An independent filter that continues from the newest event."""
        other = BufferedEkf(self.config)
        other._events = [replace(event) for event in self._events[-1:]]  # this one may be applied again
        other.telemetry_s = self.telemetry_s
        return other

    def statistics(self) -> dict[str, int]:
        """Numbers of accepted, refused, recovered and late measurements."""
        return dict(self._done + Counter(e.outcome for e in self._events if e.outcome))

    def _count_until(self, stamp_s: float) -> int:
        """Number of events up to a stamp."""
        return bisect.bisect_right(self._events, (stamp_s, _CLONE), key=lambda e: e.key)

    def _insert(self, event: _Event) -> None:
        first = bisect.bisect_right(self._events, event.key, key=lambda e: e.key)
        if first == 0 and self._events:
            self._done["too late"] += 1
            return
        self._events.insert(first, event)
        for i in range(first, len(self._events)):
            again = self._events[i]
            again.after = self._at(again.key[0], i) or self._begun(again)
            again.outcome = again.apply(again.after)
        horizon = self._events[-1].key[0] - _BUFFER_S
        while self._events[0].key[0] < horizon:
            if outcome := self._events.pop(0).outcome:
                self._done[outcome] += 1

    def _begun(self, event: _Event) -> Ekf:
        """The filter before the first event."""
        ekf = Ekf(self.config)
        if event.start is not None:
            ekf.reset_pose(*event.start)
        return ekf

    def _at(self, stamp_s: float, count: int) -> Ekf | None:
        """The filter propagated to a stamp from the last of ``count`` events; velocity and angles are interpolated to
        the next reading."""
        if count == 0:
            return None
        before = self._events[count - 1]
        assert before.after is not None
        ekf, dt = before.after.copy(), stamp_s - before.key[0]
        if dt <= 0:
            return ekf
        start = ekf.velocity
        if self.config.literal:  # the printed filter keeps a reading until the next one
            ekf.predict(dt, start, ekf.battery)
            return ekf
        following = next((e.sample for e in self._events[count:] if e.sample is not None), None)
        if following is not None:
            reach = following.stamp_s - before.key[0]
            if reach < _SILENCE_S and math.isfinite(float(following.velocity_m_s.sum())):
                ekf.velocity = start + min(1.0, dt / reach) * (following.velocity_m_s - start)
            rate = _rate(ekf, following)
        else:
            left_s = ekf.read_s + _PACKET_S - before.key[0] if math.isfinite(ekf.read_s) else 0.0
            rate = ekf.read_rate * min(1.0, max(0.0, left_s) / dt)
        ekf.predict(dt, 0.5 * (start + ekf.velocity), ekf.battery, rate)
        return ekf


def _read(ekf: Ekf, sample: TelemetrySample, ranged: bool) -> str:
    """Apply a state message."""
    if math.isfinite(float(sample.velocity_m_s.sum())):
        ekf.velocity, ekf.ranged = sample.velocity_m_s, ranged
    ekf.read_rate = _rate(ekf, sample)
    if math.isfinite(sample.battery):
        ekf.battery = sample.battery
    if not math.isfinite(float(sample.rpy_rad.sum())):
        return ""
    ekf.read_rpy_rad, ekf.read_s = sample.rpy_rad, sample.stamp_s
    return f"attitude {ekf.update_attitude(sample.rpy_rad).value}"


def _rate(ekf: Ekf, sample: TelemetrySample) -> FloatArray:
    """Euler angle rates [rad/s] between the last attitude reading and this one; zero across a gap."""
    dt = sample.stamp_s - ekf.read_s
    if not 0.0 < dt < _SILENCE_S or not math.isfinite(float(sample.rpy_rad.sum())):
        return np.zeros(3)
    return wrapped(sample.rpy_rad - ekf.read_rpy_rad) / dt
