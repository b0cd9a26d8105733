"""Cases of judged flights and their results."""

from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class Case:
    """One case."""

    world: str
    seed: int
    fault: str = "none"
    perception: str = "truth"
    """Source of the planner's states: ``truth``, ``slam``, or ``udp`` (the SLAM over UDP in real time)."""
    behaviour: str = "goto"
    """A name in `behaviours.BEHAVIOURS`."""

    @property
    def name(self) -> str:
        """Of its files."""
        name = f"{self.world}_{self.seed}_{self.fault}_{self.perception}"
        return name if self.behaviour == "goto" else f"{name}_{self.behaviour}"


@dataclass(slots=True)
class Flown:
    """Result of a case."""

    case: Case
    reached: bool = False
    ended: str = ""
    """The planner's final phase, or the reason of the landing."""
    contacts: int = 0
    """Contact events (`contact_events`)."""
    crashed: bool = False
    landed: bool = False
    time_s: float = 0.0
    """Duration from take-off to the goal or the end."""
    oracle_s: float = 0.0
    """Duration of the shortest path in the true map, at the same speed and with the same take-off."""
    path_m: float = 0.0
    distance_m: float = 0.0
    """Final distance to the goal."""
    home_m: float = 0.0
    """Final distance to the take-off."""
    exits: list[int] = field(default_factory=lambda: [0, 0, 0])
    """Number of true exits, of reported ones, and of correct ones."""
    cruise_m_s: float = 0.0
    """Median speed in free space."""
    clearance_p5_m: float = 0.0
    """5th percentile of the clearance beyond the hull."""
    clearance_min_m: float = 0.0
    cpu_ms: float = 0.0
    """CPU time of planning and mapping per tick."""
    cpu_worst_ms: float = 0.0
    off: list[int] = field(default_factory=lambda: [0, 0])
    """Ticks with metric scale; those of them with an inconsistent pose (`is_beyond`)."""
    off_m: float = 0.0
    """Maximum horizontal pose error in ticks with metric scale."""
    dangers: tuple[str, ...] = ()
    """Dangers handled by the supervisor."""
    track_w: list[list[float]] = field(default_factory=list)
    """``(N, 3)`` true path, for a top view."""

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    @classmethod
    def of_record(cls, record: dict[str, Any]) -> "Flown":
        """From JSON."""
        return cls(**{**record, "case": Case(**record["case"]), "dangers": tuple(record["dangers"])})
