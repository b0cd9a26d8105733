"""Dead reckoning of the camera position from the poses of the last seconds.

Horizontal motion comes from velocities since the frames of the last second, vertical motion from height, which drifts
less, since those of five seconds. The result is an interval with uniform density, not a Gaussian.
"""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.estimation.telemetry.visual_memory import Sightings
from edgeslam_torch.noise import HEIGHT_M, STAMP_S
from edgeslam_torch.types import FloatArray

REACH_S = 5.0
"""Time over which heights are compared with the map."""
_INTEGRATED_S = 1.0
"""Time over which velocities are integrated; quantisation of 0.1 m/s adds up to as many metres per second."""
_NOISE_M = 0.05
"""Three standard deviations of a range reading, and of a tracked position."""
_STEP_M, _STEP_M_S = 0.08, 1.0
"""Minimum height change of a floor step: noise plus twice the maximum climb rate."""
_HOLE_S = 0.5
_FEW = 4
"""Minimum number of poses for a comparison of heights: a second of flight."""


@dataclass(frozen=True, slots=True)
class Reckoned:
    """Camera position in the axes of the drone's power-on world."""

    R_w_m: FloatArray
    """``(3, 3)`` map to those axes."""
    centre: FloatArray
    """``(3,)`` [map units]."""
    doubt: FloatArray
    """``(3,)`` maximum error along each axis [map units]."""


def reckoned(model: TelemetryModel, recent: Sightings, stamp_s: float) -> Reckoned | None:
    """Position of a frame's camera; None where telemetry does not cover it.

    Args:
        model: Telemetry with usable velocities, aligned with the map.
        recent: Tracked poses of the last `REACH_S`, at least one.
        stamp_s: Stamp of the frame.
    """
    late_s = math.hypot(model.delay_sigma_s, STAMP_S)
    frame_s = stamp_s - model.delay_s + np.array([0.0, -late_s, late_s])
    stamps_s = recent.stamps_s - model.delay_s
    late = stamps_s >= stamps_s.max() - _INTEGRATED_S
    if not model.track.covered(stamps_s[late].min()[None], frame_s[2:])[0]:
        return None
    moments_s = np.concatenate([stamps_s, frame_s])
    arm = model.track.attitude(moments_s) @ model.T_b_c[:3, 3]  # from the body to the camera [m]
    seen = model.scale * recent.T[:, :3, 3] @ model.R_w_m.T
    step_m_s = model.config.velocity_step_m_s
    path = model.track.displacement(moments_s, 0.5 * step_m_s * model.truncates) + arm
    start = np.median(seen[late] - path[:-3][late], axis=0)
    lag_s = float(frame_s[0] - np.median(stamps_s[late]))
    way = np.abs(start + path[-3] - np.median(seen[late], axis=0))
    centre = start + path[-3]
    doubt = _NOISE_M + step_m_s * lag_s + _unsure(path[-3:], way, model.scale_sigma_log)
    height = _by_height(model, stamps_s, seen[:, 2] - arm[:-3, 2], frame_s)
    if height is not None and height[1] < doubt[2]:
        centre[2], doubt[2] = height[0] + arm[-3, 2], height[1]
    return Reckoned(model.R_w_m, centre / model.scale, doubt / model.scale)


def _by_height(
    model: TelemetryModel, stamps_s: FloatArray, seen: FloatArray, frame_s: FloatArray
) -> tuple[float, float] | None:
    """The body's height at a frame and its maximum error [m], from its heights ``(S,)`` in the map and telemetry.

    None without heights, or after a step of the floor (furniture below) that leaves too few of them.
    """
    name = model.height or ""
    times_s, z = model.track.heights().get(name, (np.zeros(0), np.zeros(0)))
    lately = times_s >= stamps_s.min() - _HOLE_S
    times_s, z = times_s[lately], z[lately]
    if len(times_s) == 0 or not (times_s[0] <= frame_s.min() and frame_s.max() <= times_s[-1]):
        return None
    between_s = np.diff(times_s)
    breaks = np.flatnonzero((np.abs(np.diff(z)) > _STEP_M + _STEP_M_S * between_s) | (between_s > _HOLE_S))
    since_s = float(times_s[breaks[-1] + 1] if len(breaks) else times_s[0])
    use = (stamps_s >= since_s) & (stamps_s <= times_s[-1])
    if np.count_nonzero(use) < _FEW or frame_s.min() < since_s:
        return None
    then, now = np.interp(stamps_s[use], times_s, z), np.interp(frame_s, times_s, z)
    level = float(now[0] - np.median(then - seen[use]))
    noise_m = max(_NOISE_M, 3.0 * HEIGHT_M[name])
    return level, float(noise_m + _unsure(now, np.abs(now[0] - np.median(then)), model.scale_sigma_log))


def _unsure(around: FloatArray, way: FloatArray, scale_sigma_log: float) -> FloatArray:
    """Maximum error from the uncertain stamp, by values ``(3, ...)`` at the nominal, earliest and latest stamp, and
    from the uncertain scale."""
    return np.asarray(np.abs(around - around[0]).max(axis=0) + 2.0 * scale_sigma_log * way)
