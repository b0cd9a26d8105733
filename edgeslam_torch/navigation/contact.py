"""Obstruction of the flight: contact with unseen obstacles, and places of repeated tracking loss."""

import math
from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.map_views import Places
from edgeslam_torch.navigation.speed_dither import STEP_M_S
from edgeslam_torch.types import FloatArray

PUSHED_M_S = 0.15
"""Minimum commanded speed; a drifting drone may be as fast as slower ones."""
_STANDS_M_S, _PUSH_S = 0.04, 1.5
_PAUSE_S = 0.5
"""Gap between calls after which the detection restarts: other commands were sent meanwhile."""
LOST_M = 1.5
"""Distance within which tracking losses belong to one place."""


@dataclass(slots=True)
class Push:
    """Compares commanded and achieved motion.

    Close to a surface the pose estimate jitters without progress, so its speed alone is no evidence of motion. The
    reported velocity does not jitter, but may be stale: estimated progress must also be below half the expected one.
    """

    _since_s: float = math.nan
    _last_s: float = math.nan
    _towards_w: FloatArray = field(default_factory=lambda: np.zeros(2))
    _gone_m: float = 0.0
    """Estimated progress since then in the commanded direction [m]."""
    _shook: bool = False
    """Whether the pose moved since then."""

    def holds(self, state: DroneState, towards_w: FloatArray | None, now_s: float) -> bool:
        """Whether an obstacle holds the drone; call it in every control cycle.

        Args:
            state: Current state.
            towards_w: ``(2,)`` horizontal direction of a command faster than `PUSHED_M_S` that was sent, else None.
            now_s: Time on the clock of the states.
        """
        turned = towards_w is not None and float(towards_w @ self._towards_w) < 0.0
        speed = float(np.linalg.norm(state.velocity_w[:2]))
        stands = state.reported_speed_m_s < STEP_M_S  # false for NaN
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


@dataclass(slots=True)
class Losses:
    """Counts tracking losses that made the supervisor intervene, for one place at a time: a textureless view fails
    repeatedly."""

    count: int = 0
    """Losses at the current place."""
    _place: Places = field(default_factory=Places)
    """Position of the first loss."""
    _lost: bool = False

    def note(self, state: DroneState) -> None:
        """Process a state."""
        if state.tracked:
            self._lost = False
        elif state.overridden and not self._lost:
            self._lost = True
            here = state.p_w[:2]
            if float(self._place.away_m(here)) > LOST_M:
                self._place, self.count = Places(state.views, [here]), 0
            self.count += 1
