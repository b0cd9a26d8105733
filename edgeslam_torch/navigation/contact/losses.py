"""How often a pose was lost about one place: what shows nothing once does so again."""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.map_update import MapUpdate
from edgeslam_torch.types import FloatArray


@dataclass(slots=True)
class Losses:
    """Counts losses about which something else than to go on was done, those of one place after the other.

    Args:
        about_m: Distance from the first of them beyond which another place begins.
    """

    about_m: float
    count: int = 0
    """About the present place."""
    _place_w: FloatArray | None = None
    """``(2,)`` of the first of them."""
    _lost: bool = False

    def note(self, state: DroneState) -> None:
        """Take in a moment."""
        if state.tracked:
            self._lost = False
        elif state.overridden and not self._lost:
            self._lost = True
            here = state.p_w[:2]
            if self._place_w is None or float(np.linalg.norm(here - self._place_w)) > self.about_m:
                self._place_w, self.count = here.copy(), 0
            self.count += 1

    def carry(self, update: MapUpdate) -> None:
        """Take the place along with the map."""
        if self._place_w is not None:
            self._place_w = update.points(self._place_w[None])[0]
