"""Heights of the drone's SDK: range sensor, SDK height, barometer, above a floor that has steps."""

import math

import numpy as np

from edgeslam_torch.estimation.sensors.rows import Rows
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack, is_range
from edgeslam_torch.noise import DELAY_S, HEIGHT_M, HEIGHT_MEMORY_S, TILT_RAD
from edgeslam_torch.types import FloatArray, IntArray, TelemetrySample

_PAUSE_S = 0.35
"""Maximum time between two messages whose heights give a velocity."""
FLOOR_M = 30.0
"""Uninformative prior on the floor's level."""


def floor_segments(stamp_s: FloatArray, z_m: FloatArray, z_predicted_m: FloatArray, step_m: float) -> IntArray:
    """Number the segments between floor steps (furniture passing below), shape ``(N,)``.

    A step is a change between neighbours that differs from the predicted change by more than ``step_m``, or a gap of
    more than half a second.
    """
    if len(z_m) == 0:
        return np.zeros(0, dtype=np.int64)
    jump = np.abs(np.diff(z_m) - np.diff(z_predicted_m)) > step_m
    hole = np.diff(stamp_s) > 0.5
    return np.concatenate([[0], np.cumsum(jump | hole)]).astype(np.int64)


def climb(before: TelemetrySample | None, sample: TelemetrySample, step_m_s: float) -> float:
    """Vertical velocity [m/s] by two successive readings of the range sensor; NaN without them, and across a floor
    step. SDK height and barometer are too coarse for it.

    Args:
        before: The state message before.
        sample: The present one.
        step_m_s: Resolution of the reported velocity.
    """
    if before is None or not 0.0 < sample.stamp_s - before.stamp_s < _PAUSE_S:
        return math.nan
    if not (is_range(before.tof_m, before.rpy_rad) and is_range(sample.tof_m, sample.rpy_rad)):
        return math.nan
    pause_s = sample.stamp_s - before.stamp_s
    found = (sample.tof_m - before.tof_m) / pause_s
    error = step_m_s + 3.0 * math.sqrt(2.0) * HEIGHT_M["tof"] / pause_s
    return found if abs(found - float(sample.velocity_m_s[2])) < error else math.nan


def heights(
    track: TelemetryTrack, name: str, at_s: FloatArray, per_scale_w: FloatArray, arm_b: FloatArray, delay_sigma_s: float
) -> Rows | None:
    """Heights of the camera above a floor of unknown level; None without readings at two times.

    Args:
        track: Telemetry.
        name: ``tof``, ``h`` or ``baro``.
        at_s: Increasing times ``(K,)`` on its clock.
        per_scale_w: Change of the positions per sigma of the scale ``(K, 3)`` [m].
        arm_b: From body to camera ``(3,)``, body axes [m].
        delay_sigma_s: Standard deviation of the video delay.
    """
    stamp, z = track.heights().get(name, (np.zeros(0), np.zeros(0)))
    if len(stamp) < 2:
        return None
    sigma = HEIGHT_M[name]
    own = track.displacement(stamp)[:, 2]
    segment = floor_segments(stamp, z, own, step_m=max(0.08, 4.0 * sigma))
    after = np.clip(np.searchsorted(stamp, at_s), 1, len(stamp) - 1)
    near = (at_s >= stamp[after - 1]) & (at_s <= stamp[after]) & (stamp[after] - stamp[after - 1] < 0.35)
    use = np.flatnonzero(near & (segment[after] == segment[after - 1]))
    part = segment[after[use]]
    use = use[np.bincount(part)[part] > 1] if len(use) else use
    if len(use) < 2:
        return None
    part = np.unique(segment[after[use]], return_inverse=True)[1]
    R = track.attitude(at_s[use])
    h = np.interp(at_s[use], stamp, z) + R[:, 2, :] @ arm_b
    M, K = len(use), len(at_s)
    D = np.zeros((M, K, 3))
    D[np.arange(M), use, 2] = 1.0
    same = part[:, None] == part[None]
    t = at_s[use]
    lasting = sigma**2 * np.exp(-np.abs(t[:, None] - t[None]) / HEIGHT_MEMORY_S)
    level = FLOOR_M**2 * same
    rise = h - (same @ h) / same.sum(1)
    way = track.displacement(t)
    way = way - (same @ way) / same.sum(1)[:, None]
    fast = (np.interp(t + 0.1, stamp, own) - np.interp(t - 0.1, stamp, own)) / 0.2
    none = np.zeros(M)
    tilt = TILT_RAD * np.stack([-way[:, 1], way[:, 0], none], axis=1)  # the last row of hat(way)
    delay = min(delay_sigma_s, DELAY_S)
    per_scale = per_scale_w[use, 2]
    per_scale = per_scale - (same @ per_scale) / same.sum(1)
    common = np.column_stack([per_scale, tilt, delay * fast, none])
    rounded = name == "tof"  # quantised to centimetres; the others move in steps or drift
    white = np.full(M, sigma**2 if rounded else 0.25 * sigma**2)
    slow = (0.1 if rounded else 1.0) * lasting + level
    return Rows(D, h, white, slow, common, np.arange(M), np.abs(rise))
