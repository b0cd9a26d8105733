"""Counter of tracking losses at one place: a textureless view fails repeatedly."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.types import FloatArray


@dataclass(slots=True)
class Losses:
    """Counts tracking losses that made the supervisor intervene, for one place at a time.

    Args:
        about_m: Distance from the first loss beyond which another place begins.
    """

    about_m: float
    count: int = 0
    """Losses at the current place."""
    _place_w: FloatArray | None = None
    """``(2,)`` position of the first loss."""
    _lost: bool = False

    def note(self, state: DroneState) -> None:
        """Process a state."""
        if state.tracked:
            self._lost = False
        elif state.overridden and not self._lost:
            self._lost = True
            here = state.p_w[:2]
            if self._place_w is None or float(np.linalg.norm(here - self._place_w)) > self.about_m:
                self._place_w, self.count = here.copy(), 0
            self.count += 1

    def carry(self, update: MapUpdate) -> None:
        """Apply a map correction."""
        if self._place_w is not None:
            self._place_w = update.points(self._place_w[None])[0]
