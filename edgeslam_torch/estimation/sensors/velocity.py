r"""Velocities of the drone's SDK: displacement between two moments with covariance, and what quantisation loses.

A Tello truncates to 0.1 m/s: every reading is 0 to 1 step low, and speeds below one step read as zero. The mean loss
depends on the speed, which vision measures up to the scale :math:`s`. For a reading at the visual velocity :math:`u`
the expected remainder is

.. math:: r(s u) = s u - E[Q(s u + n)], \qquad n \sim N(0, \sigma^2)

with rounding or truncation :math:`Q` and noise :math:`\sigma` before it. Velocities plus remainders give a scale, which
gives other remainders: a fixed point, see `remainder_gain`.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.estimation.sensors.rows import Rows
from edgeslam_torch.estimation.telemetry.quantisation import Rounding, remainder
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack, cubic
from edgeslam_torch.estimation.telemetry.visual_memory import Displacements, Sightings
from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.noise import DELAY_S, TILT_RAD, VELOCITY_BIAS_M_S, VELOCITY_BIAS_MEMORY_S, VELOCITY_SENSOR_M_S
from edgeslam_torch.types import FloatArray

_LASTING, _VARIES_S = 0.25, 1.0
"""Share of a quantisation error's variance that is constant while the reading is, and correlation time of the rest [s].
Over a reading of three seconds the mean error is .01 m/s at varying speed; for a constant speed it would be .029."""
LONGEST_S = 10.0
"""Maximum time between two positions for integrated velocity."""
_HALF_S = 0.05
"""Half the averaging time of one reading."""
_MOST_GAIN = 0.9
_PROBE = 0.05
"""Relative change of the scale for the numeric derivative."""


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


def displacements(
    track: TelemetryTrack,
    at_s: FloatArray,
    per_scale_w: FloatArray,
    p_w: FloatArray,
    gain_sigma: FloatArray,
    arm_b: FloatArray,
    step_m_s: float,
    truncates: float,
    delay_sigma_s: float,
) -> Rows | None:
    """Displacements of the camera between consecutive times; None where telemetry covers none.

    Args:
        track: Telemetry.
        at_s: Increasing times ``(K,)`` on its clock.
        per_scale_w: Change of the positions per sigma of the scale ``(K, 3)`` [m].
        p_w: The positions ``(K, 3)`` [m], up to a common one.
        gain_sigma: Error of each velocity column ``(3,)`` as a share of the motion along it, by telemetry or the map;
            independent between intervals.
        arm_b: From body to camera ``(3,)``, body axes [m].
        step_m_s: Quantisation step_m_s.
        truncates: Probability that velocities are truncated, not rounded.
        delay_sigma_s: Standard deviation of the video delay.
    """
    start, end = at_s[:-1], at_s[1:]
    use = np.flatnonzero(track.covered(start, end) & (end - start < LONGEST_S))
    if len(use) == 0:
        return None
    moved = np.diff(track.displacement(at_s, truncates * 0.5 * step_m_s), axis=0)[use]
    lever = track.attitude(at_s) @ arm_b
    d = moved + np.diff(lever, axis=0)[use]
    start, end, L = start[use], end[use], (end - start)[use]
    N, K = len(use), len(at_s)
    D = np.zeros((N, 3, K, 3))
    for axis in range(3):
        D[np.arange(N), axis, use + 1, axis] = 1.0
        D[np.arange(N), axis, use, axis] = -1.0
    measured = track.readings
    share = _shares(measured.stamp_s, start, end)  # (N, S)
    involved = np.flatnonzero(share.any(axis=0))
    share = share[:, involved]
    R_w = track.axes()[involved]
    raw = np.einsum("swa,sw->sa", R_w, measured.velocity[involved])
    U = _runs(share, measured.stamp_s[involved], raw, R_w, step_m_s, truncates)
    memory = np.exp(-np.abs(start[:, None] - start[None]) / VELOCITY_BIAS_MEMORY_S)
    bias = VELOCITY_BIAS_M_S**2 * memory * np.outer(L, L)
    R_c = track.axes()[np.searchsorted(measured.stamp_s, 0.5 * (start + end))]
    way = np.linalg.norm([np.einsum("nwa,nw->na", R_c, x) for x in (np.diff(p_w, axis=0)[use], moved)], axis=0)
    gain = R_c * (gain_sigma * way)[:, None]
    unproven = np.einsum("iac,ibc,ij->iajb", gain, gain, np.eye(N)).reshape(3 * N, 3 * N)
    slow = U @ U.T + unproven + np.einsum("ij,ab->iajb", bias, np.eye(3)).reshape(3 * N, 3 * N)
    half = 0.5 * step_m_s * math.sqrt(truncates * (1.0 - truncates))
    speed = track.displacement(at_s + 0.05) - track.displacement(at_s - 0.05)
    delay = min(delay_sigma_s, DELAY_S)
    common = np.concatenate(
        [
            np.diff(per_scale_w, axis=0)[use][..., None],
            TILT_RAD * hat(d),
            (delay * 10.0 * np.diff(speed, axis=0)[use])[..., None],
            (half * np.einsum("ns,sa->na", share, measured.sign[involved]))[..., None],
        ],
        axis=-1,
    )
    white = np.repeat(VELOCITY_SENSOR_M_S**2 * 0.1 * L, 3)
    group = np.repeat(np.arange(N), 3)
    return Rows(
        D.reshape(3 * N, K, 3),
        d.ravel(),
        white,
        slow,
        common.reshape(3 * N, -1),
        group,
        np.repeat(np.linalg.norm(d, axis=1), 3),
    )


def _shares(stamp_s: FloatArray, start_s: FloatArray, end_s: FloatArray) -> FloatArray:
    """Time [s] for which each reading is valid in each interval ``(N, S)``: to the midpoints with its neighbours."""
    middle = 0.5 * (stamp_s[1:] + stamp_s[:-1])
    low, high = np.append(-np.inf, middle), np.append(middle, np.inf)
    overlap = np.minimum(end_s[:, None], high) - np.maximum(start_s[:, None], low)
    return np.maximum(overlap, 0.0)


def _runs(
    share: FloatArray, stamp_s: FloatArray, velocity: FloatArray, R_w: FloatArray, step_m_s: float, truncates: float
) -> FloatArray:
    """Errors of displacements per standard deviation of each quantisation error ``(3 N, runs)``.

    A quantisation error is uniform within a step, or within two steps for a zero that may be truncated. While a reading
    stays constant, part of its error does as well; the rest changes with the speed.

    Args:
        share: From `_shares` ``(N, S)``.
        stamp_s: Stamps of the readings ``(S,)``.
        velocity: Readings in the drone's own axes ``(S, 3)``.
        R_w: Those axes to world ``(S, 3, 3)``.
        step_m_s: Quantisation step.
        truncates: Probability of truncation.
    """
    N = len(share)
    columns = []
    for axis in range(3):
        v = velocity[:, axis]
        changes = np.append(True, np.abs(np.diff(v)) > 1e-6)
        first_s = stamp_s[changes][np.cumsum(changes) - 1]
        later = np.floor((stamp_s - first_s) / _VARIES_S)
        for begin, part in ((changes, _LASTING), (changes | np.append(True, np.diff(later) > 0), 1.0 - _LASTING)):
            at = np.flatnonzero(begin)
            zero = np.abs(v[at]) < 1e-6
            sigma = step_m_s * np.sqrt(part / 12.0 * np.where(zero, 1.0 + 3.0 * truncates, 1.0))
            turned = np.stack([np.add.reduceat(share * R_w[:, w, axis], at, axis=1) for w in range(3)], axis=1)
            columns.append((turned * sigma).reshape(3 * N, -1))
    return np.concatenate(columns, axis=1)
