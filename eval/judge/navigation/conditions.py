"""Faults that a flight must end well with."""

from dataclasses import dataclass, field

from edgeslam_torch.drone.emulator.lockstep import Outage, Radio


@dataclass(frozen=True, slots=True)
class Conditions:
    """What goes wrong in a flight."""

    radio: Radio = field(default_factory=Radio)
    wind_m_s: float = 0.0
    """Across the take-off's heading; half of it again as gusts."""
    scale: float = 1.0
    """The pilot's metre in true metres: 1.3 believes everything to be 1.3 times nearer than it is."""
    stated_scale_sigma: float = 0.0
    battery: float = 1.0
    hung_s: tuple[float, float] | None = None
    """When the planner hangs."""
    dark_s: tuple[float, float] | None = None
    """When the pictures are black."""


FAULTS = {
    "none": Conditions(),
    "outage": Conditions(Radio(outages=(Outage("video", 14.0, 17.0),))),
    "loss": Conditions(Radio(loss=0.05)),
    "delay": Conditions(Radio(video_s=0.8)),
    "wind": Conditions(wind_m_s=0.3),
    "scale_long": Conditions(scale=1.3, stated_scale_sigma=0.15),
    "scale_short": Conditions(scale=1.0 / 1.3, stated_scale_sigma=0.15),
    "scale_unsaid": Conditions(scale=1.0 / 1.3),
    "blackout": Conditions(dark_s=(14.0, 60.0)),
    "battery": Conditions(battery=0.28),
    "hung": Conditions(hung_s=(14.0, 60.0)),
}
"""By name; ``scale_unsaid`` states no sigma: what a silently wrong scale does."""
