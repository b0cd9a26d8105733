"""Settings of the Kalman filter and of the metric scale, with units and reasons."""

import math
from dataclasses import dataclass
from typing import Literal

_POSITIVE = (
    "velocity_step_m_s",
    "buffer_s",
    "interval_s",
    "window_s",
    "max_gap_s",
    "alignment_sigma_rad",
)
_NOT_NEGATIVE = (
    "beta",
    "lambda_tau",
    "sigma_bias_m_s",
    "initial_sigma_angle_rad",
    "literal_beta",
    "min_speed_m_s",
)


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
    initial_sigma_angle_rad: float = math.radians(1.0)
    """Standard deviation of the first attitude, per axis; attitude is read in whole degrees."""
    gate_probability: float = 0.95
    """Innovations beyond this quantile of chi-square are refused."""
    refusals_before_recovery: int = 5
    """Refusals in a row after which the covariance is inflated and the measurement taken."""
    buffer_s: float = 3.0
    """Maximum age of a late measurement that is still inserted in time order."""
    delay_s: float | None = None
    """Video delay behind telemetry [s]; ``None`` estimates it from the motion."""
    delay_range_s: tuple[float, float] = (-0.2, 1.2)
    """Range that is searched; a Tello's video is 0.3-0.8 s late."""
    interval_s: float = 0.5
    """Length of one displacement: long against pose noise, short against the oscillation of a hand or drone."""
    window_s: float = 120.0
    """Age beyond which displacements are dropped."""
    max_gap_s: float = 0.35
    """Maximum gap of telemetry or tracking inside a displacement."""
    alignment_sigma_rad: float = math.radians(3.0)
    """Standard deviation of the camera's mount, per axis, until it is estimated from rotations."""
    min_speed_m_s: float = 0.06
    """RMS metric speed below which an interval does not constrain the scale (hover, rotation in place)."""

    def __post_init__(self) -> None:
        for name in _POSITIVE:
            _require(getattr(self, name) > 0, name, "positive", getattr(self, name))
        for name in _NOT_NEGATIVE:
            _require(getattr(self, name) >= 0, name, "at least 0", getattr(self, name))
        _require(self.window_s >= 2 * self.interval_s, "window_s", "at least two interval_s", self.window_s)
        _require(0.5 <= self.gate_probability < 1, "gate_probability", "in [0.5, 1)", self.gate_probability)
        _require(self.refusals_before_recovery >= 1, "refusals_before_recovery", ">= 1", self.refusals_before_recovery)
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
