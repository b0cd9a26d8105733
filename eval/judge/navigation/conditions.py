"""Injected faults that a flight must survive."""

from dataclasses import dataclass, field

from edgeslam_torch.drone.emulator.lockstep import Outage, Radio


@dataclass(frozen=True, slots=True)
class Conditions:
    """Faults of a flight."""

    radio: Radio = field(default_factory=Radio)
    wind_m_s: float = 0.0
    """Constant wind across the take-off heading, plus gusts of half of it."""
    scale: float = 1.0
    """True metres per estimated metre: at 1.3 all distances are underestimated by 1.3."""
    stated_scale_sigma: float = 0.0
    battery: float = 1.0
    hung_s: tuple[float, float] | None = None
    """Interval in which the planner hangs."""
    dark_s: tuple[float, float] | None = None
    """Interval with black frames."""


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
"""By name; ``scale_unsaid`` is a wrong scale with zero standard deviation."""
