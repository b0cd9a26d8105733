"""Settings of the Kalman filter and of the metric scale, with units and reasons."""

from dataclasses import dataclass
from typing import Literal

INTERVAL_S = 0.5
"""Length of one displacement: long against pose noise, short against the oscillation of a hand or drone."""
WINDOW_S = 120.0
"""Age beyond which displacements are dropped."""
MAX_GAP_S = 0.35
"""Maximum gap of telemetry or tracking inside a displacement."""
MIN_SPEED_M_S = 0.06
"""RMS metric speed below which an interval does not constrain the scale (hover, rotation in place)."""

_NOT_NEGATIVE = ("beta", "lambda_tau", "sigma_bias_m_s", "literal_beta")


@dataclass(frozen=True, slots=True)
class FusionConfig:
    """Kalman filter, scale and delay."""

    literal: bool = False
    """Paper eqs. (8)-(14) as printed: no time step in Q, no wrap, no gate, absolute visual update."""
    velocity_frame: Literal["world", "body"] = "world"
    """Frame of ``TelemetrySample.velocity_m_s``: that of power-on on real flights; paper eq. (9) assumes the body's."""
    velocity_rounding: Literal["auto", "nearest", "truncate"] = "auto"
    """How the drone quantises its velocity: a Tello truncates. ``auto`` estimates it from the flight."""
    velocity_step_m_s: float = 0.1
    """Step of the velocity readings; the SDK's are whole decimetres per second."""
    beta: float = 1.0
    """Growth of the process noise with the spent battery, paper eq. (10)."""
    lambda_tau: float = 0.5
    """Growth of the process noise with the time since the last visual update [1/s], paper eq. (10)."""
    literal_beta: float = 1e-3
    """The paper's beta, which there has the units of the whole covariance (m^2 and rad^2)."""
    sigma_bias_m_s: float = 0.03
    """Initial velocity bias (0 removes the bias from the state: the paper's six states)."""
    delay_s: float | None = None
    """Video delay behind telemetry [s]; ``None`` estimates it from the motion."""
    delay_range_s: tuple[float, float] = (-0.2, 1.2)
    """Range that is searched; a Tello's video is 0.3-0.8 s late."""

    def __post_init__(self) -> None:
        _require(self.velocity_step_m_s > 0, "velocity_step_m_s", "positive", self.velocity_step_m_s)
        for name in _NOT_NEGATIVE:
            _require(getattr(self, name) >= 0, name, "at least 0", getattr(self, name))
        _require(self.delay_range_s[0] < self.delay_range_s[1], "delay_range_s", "ascending", self.delay_range_s)
        _require(
            self.velocity_rounding in ("auto", "nearest", "truncate"),
            "velocity_rounding",
            "auto, nearest or truncate",
            self.velocity_rounding,
        )
        _require(self.velocity_frame in ("world", "body"), "velocity_frame", "world or body", self.velocity_frame)


def _require(condition: bool, name: str, what: str, value: object) -> None:
    if not condition:
        raise ValueError(f"{name} must be {what}, got {value}")
