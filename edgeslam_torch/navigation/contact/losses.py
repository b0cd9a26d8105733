"""Counter of tracking losses at one place: a textureless view fails repeatedly."""

from dataclasses import dataclass, field

from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.map_views import Places


@dataclass(slots=True)
class Losses:
    """Counts tracking losses that made the supervisor intervene, for one place at a time.

    Args:
        about_m: Distance from the first loss beyond which another place begins.
    """

    about_m: float
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
            if float(self._place.away_m(here)) > self.about_m:
                self._place, self.count = Places(state.views, [here]), 0
            self.count += 1
