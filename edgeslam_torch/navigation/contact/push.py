"""Whether something holds a drone: it was told to move for a while, and did not."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.types import FloatArray

PUSHED_M_S = 0.15
"""Slower commands say nothing: a drone that drifts may be as fast."""
_STANDS_M_S, _PUSH_S = 0.04, 1.5
_PAUSE_S = 0.5
"""Not asked for longer, it was told something else meanwhile."""
_TOLD_M_S = 0.1
"""A Tello tells whole decimetres a second, cut off: slower is 0."""


@dataclass(slots=True)
class Push:
    """Follows one command after the other.

    A pose that shakes beside what is too near to be seen moves at each moment and comes nowhere. The drone's own
    velocity does not shake, but a radio may repeat an old one: so the pose must not have come half as far, either.
    """

    _since_s: float = math.nan
    _last_s: float = math.nan
    _towards_w: FloatArray = field(default_factory=lambda: np.zeros(2))
    _gone_m: float = 0.0
    """Way by the pose since then, in the direction of the command."""
    _shook: bool = False
    """Whether the pose moved since then."""

    def holds(self, state: DroneState, towards_w: FloatArray | None, now_s: float) -> bool:
        """Whether something does, now; to be asked at every moment.

        Args:
            state: Of this moment.
            towards_w: ``(2,)`` level unit vector of a command faster than `PUSHED_M_S` that was passed on; None without.
            now_s: On the clock of the states.
        """
        turned = towards_w is not None and float(towards_w @ self._towards_w) < 0.0
        speed = float(np.linalg.norm(state.velocity_w[:2]))
        stands = state.reported_speed_m_s < _TOLD_M_S  # false where the drone says nothing
        if towards_w is None or turned or (speed > _STANDS_M_S and not stands):
            self._since_s, self._towards_w = math.nan, np.zeros(2) if towards_w is None else towards_w
            return False
        if math.isnan(self._since_s) or now_s - self._last_s > _PAUSE_S:
            self._since_s = self._last_s = now_s
            self._gone_m, self._shook = 0.0, False
        self._gone_m += (now_s - self._last_s) * float(state.velocity_w[:2] @ towards_w)
        self._shook |= speed > _STANDS_M_S
        self._towards_w, self._last_s = towards_w, now_s
        pushed_s = now_s - self._since_s
        if self._shook and self._gone_m > 0.5 * PUSHED_M_S * pushed_s and pushed_s > _PUSH_S:
            self._since_s = math.nan
            return False
        return pushed_s > _PUSH_S
