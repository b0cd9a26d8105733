r"""Expected quantisation loss of velocity readings, from the visual motion.

A Tello truncates to 0.1 m/s: every reading is 0 to 1 step low, and speeds below one step read as zero. The mean loss
depends on the speed, which vision measures up to the scale :math:`s`. For a reading at the visual velocity :math:`u`
the expected remainder is

.. math:: r(s u) = s u - E[Q(s u + n)], \qquad n \sim N(0, \sigma^2)

with rounding or truncation :math:`Q` and noise :math:`\sigma` before it. Velocities plus remainders give a scale, which
gives other remainders: a fixed point, see `remainder_gain`.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.estimation.telemetry.track import TelemetryTrack, cubic
from edgeslam_torch.estimation.telemetry.visual_memory import Displacements, Sightings
from edgeslam_torch.types import FloatArray

_NOISE_STEPS = 0.4
"""Noise of a velocity before quantisation [steps]: 0.02 to 0.03 m/s of the sensor, and 0.03 to 0.04 m/s of vision over
a tenth of a second."""
_HALF_S = 0.05
"""Half the averaging time of one reading."""
_FEW_STEPS, _FINE = 4.0, 0.02
"""Speed above which the remainder is constant, and resolution of the grid below [steps]."""
_MOST_GAIN = 0.9
_PROBE = 0.05
"""Relative change of the scale for the numeric derivative."""


class Rounding(StrEnum):
    """Quantisation mode of a velocity."""

    NEAREST = "nearest"
    TRUNCATE = "truncate"


@lru_cache(maxsize=2)
def _table(rounding: Rounding) -> tuple[FloatArray, FloatArray]:
    """Speeds from 0 up, and the expected remainder at each [steps]."""
    speed = np.arange(0.0, _FEW_STEPS + 0.5 * _FINE, _FINE)
    first = 1.0 if rounding is Rounding.TRUNCATE else 0.5
    edges = first + np.arange(_FEW_STEPS + 4.0)

    def passed(x: FloatArray) -> FloatArray:
        """Expected number of quantisation thresholds below ``x`` plus noise."""
        z = (x[:, None] - edges) / (_NOISE_STEPS * math.sqrt(2.0))
        return np.array([[0.5 * math.erfc(-v) for v in row] for row in z.tolist()]).sum(axis=1)

    return speed, speed - (passed(speed) - passed(-speed))


def remainder(velocity_steps: FloatArray, rounding: Rounding) -> FloatArray:
    """Expected true minus reported velocity [steps], for true velocities [steps] of any shape."""
    speed, lost = _table(rounding)
    return np.asarray(np.sign(velocity_steps) * np.interp(np.abs(velocity_steps), speed, lost))


@dataclass(frozen=True, slots=True)
class SeenVelocity:
    """Visual velocity at each telemetry reading; ``S`` readings."""

    stamp_s: FloatArray
    """``(S,)`` of the readings."""
    camera: FloatArray
    """``(S, 3)`` in the axes of the velocity readings [map units/s]; zero without vision."""
    lever: FloatArray
    """``(S, 3)`` of the camera relative to the body, the same axes [m/s]."""
    R_w: FloatArray
    """``(S, 3, 3)`` these axes to the power-on world."""

    def lost(self, at_s: FloatArray, scale: float, step_m_s: float, rounding: Rounding) -> FloatArray:
        """Integrated remainder ``(N, 3)`` [m] at times ``(N,)``, in the power-on world; only differences matter.

        Args:
            at_s: Times on telemetry's clock.
            scale: Metres per map unit.
            step_m_s: Quantisation step.
            rounding: Quantisation mode.
        """
        body = (scale * self.camera - self.lever) / step_m_s
        rate = step_m_s * np.einsum("swa,sa->sw", self.R_w, remainder(body, rounding))
        steps = 0.5 * np.diff(self.stamp_s)[:, None] * (rate[1:] + rate[:-1])
        path = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        return np.stack([np.interp(at_s, self.stamp_s, axis) for axis in path.T], axis=-1)


def seen_velocity(
    track: TelemetryTrack, seen: Sightings, delay_s: float, R_w_m: FloatArray, T_b_c: FloatArray, max_gap_s: float
) -> SeenVelocity:
    """Velocity of the camera at each reading, interpolated from the tracked poses.

    Args:
        track: Telemetry, with two readings at least.
        seen: Poses in the map, two at least.
        delay_s: Video delay behind telemetry.
        R_w_m: Map axes to the power-on world ``(3, 3)``.
        T_b_c: Camera in the body ``(4, 4)``.
        max_gap_s: Maximum gap between poses for interpolation.
    """
    stamp = track.readings.stamp_s
    shown_s = stamp + delay_s
    p = seen.T[:, :3, 3] @ R_w_m.T
    velocity = _mean_velocity(seen.stamps_s, p, shown_s)
    velocity[~_bridged(seen.stamps_s, shown_s, max_gap_s)] = 0.0
    R_w = track.axes()
    lever = (track.attitude(stamp + _HALF_S) - track.attitude(stamp - _HALF_S)) @ T_b_c[:3, 3] / (2.0 * _HALF_S)
    seen_there, lever_there = (np.einsum("swa,sw->sa", R_w, v) for v in (velocity, lever))
    return SeenVelocity(stamp, seen_there, lever_there, R_w)


def _mean_velocity(stamp_s: FloatArray, p: FloatArray, at_s: FloatArray) -> FloatArray:
    """Mean velocity ``(N, 3)`` around each time, of a cubic through ``p`` ``(S, 3)``."""
    slope = np.gradient(p, stamp_s, axis=0)
    before, after = (cubic(stamp_s, p, slope, np.clip(at_s + h, stamp_s[0], stamp_s[-1])) for h in (-_HALF_S, _HALF_S))
    return (after - before) / (2.0 * _HALF_S)


def _bridged(stamp_s: FloatArray, at_s: FloatArray, max_gap_s: float) -> NDArray[np.bool_]:
    """Whether a time lies between two poses without a gap."""
    after = np.clip(np.searchsorted(stamp_s, at_s), 1, len(stamp_s) - 1)
    inside = (at_s >= stamp_s[0]) & (at_s <= stamp_s[-1])
    return np.asarray(inside & (stamp_s[after] - stamp_s[after - 1] < max_gap_s))


def remainder_gain(
    shown: SeenVelocity, moved: Displacements, R_w_m: FloatArray, scale: float, step_m_s: float, rounding: Rounding
) -> float:
    """Derivative of the scale implied by the remainders, from 0 (fast flight) to 0.9 (nearly all below a step).

    In slow flight most of the motion is remainder, computed from vision at the assumed scale, so that it confirms any
    scale. The fixed point is 1 / (1 - gain) times as uncertain as the fit.

    Args:
        shown: Visual velocity at the readings.
        moved: Intervals of the fit, on telemetry's clock.
        R_w_m: Map axes to the power-on world ``(3, 3)``.
        scale: Metres per map unit.
        step_m_s: Quantisation step.
        rounding: Quantisation mode.
    """
    ends = np.concatenate([moved.from_s, moved.to_s])
    n = len(moved)
    here, beyond = (shown.lost(ends, s, step_m_s, rounding) for s in (scale, (1.0 + _PROBE) * scale))
    follows = (beyond[n:] - beyond[:n]) - (here[n:] - here[:n])
    u = _PROBE * scale * moved.moved @ R_w_m.T
    return float(np.clip(np.sum(u * follows) / max(float(np.sum(u**2)), 1e-30), 0.0, _MOST_GAIN))
