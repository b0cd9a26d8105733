"""What is flown to be judged, and what came of it."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Case:
    """What is flown."""

    world: str
    seed: int
    fault: str = "none"
    perception: str = "truth"
    """``truth`` or ``slam``: what the pilot is told."""
    behaviour: str = "goto"
    """One of `behaviours.BEHAVIOURS`."""


@dataclass(slots=True)
class Flown:
    """What came of it."""

    case: Case
    reached: bool = False
    ended: str = ""
    """How: the pilot's phase, or why it landed."""
    contacts: int = 0
    """Events: a contact that lasts, or bounces at once, is one (`contact_events`)."""
    crashed: bool = False
    landed: bool = False
    time_s: float = 0.0
    """From take-off to the goal or the end."""
    oracle_s: float = 0.0
    """The shortest way with the true map, at the same speed and after the same take-off."""
    path_m: float = 0.0
    distance_m: float = 0.0
    """To the goal, in the end."""
    home_m: float = 0.0
    """To the take-off, in the end."""
    exits: list[int] = field(default_factory=lambda: [0, 0, 0])
    """How many there are; how many the drone says that there are; how many of those are right."""
    cruise_m_s: float = 0.0
    """Median speed where there is space."""
    clearance_p5_m: float = 0.0
    """Beyond the hull."""
    clearance_min_m: float = 0.0
    cpu_ms: float = 0.0
    """Planning and space, a tick."""
    cpu_worst_ms: float = 0.0
    near: list[int] = field(default_factory=lambda: [0, 0, 0])
    """Sectors with something at .3 to 1 m; of them told .3 m too far; even at two sigmas (`near_counts`)."""
    depth_age_s: list[float] = field(default_factory=lambda: [math.nan, math.nan])
    """Since the picture of the newest depth, when the pilot plans by it: median, and in 95 % of the moments."""
    off: list[int] = field(default_factory=lambda: [0, 0])
    """Moments with metres; of them, those with a pose that is farther off than it says (`is_beyond`)."""
    off_m: float = 0.0
    """Level error of the pose, at most, in moments with metres."""
    dangers: tuple[str, ...] = ()
    """What the supervisor met."""
    track_w: list[list[float]] = field(default_factory=list)
    """``(N, 3)`` true way, for pictures."""
    attitude: list[list[float]] = field(default_factory=list)
    """``(N, 5)`` beside it: clock [s]; roll, pitch, yaw [rad]; clearance beyond the hull [m]."""

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)
