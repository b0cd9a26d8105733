"""Whether a log's velocities are in the power-on world or in body axes, inferred from how the drone leans.

A multicopter accelerates where it leans. In the right frame, velocities rotated to the world change as the lean
predicts. The median lean is the mounting angle and exerts no force.
"""

import math
from collections.abc import Mapping

import numpy as np

from edgeslam_torch.types import FloatArray

_SPAN_S = 0.5
"""Interval of velocity changes and mean leans."""
_MIN_TURN_RAD = math.radians(20.0)
"""Minimum turn: without turning, both frames differ only by a constant."""
_DECISIVE = 12.0
"""Decisive log likelihood ratio: wind and control move a drone too, and half of a real flight reaches 11 for the
wrong frame. Whole flights reach 18 and 39."""


def body_frame_evidence(stamps_s: FloatArray, values: Mapping[str, FloatArray]) -> tuple[float, str]:
    """Log likelihood ratio of "body axes" over "world of power-on", and the evidence in words.

    Args:
        stamps_s: ``(M,)`` increasing.
        values: SDK name to ``(M,)`` in the SDK's units; ``vgx vgy pitch roll yaw`` are needed.

    Returns:
        0 without evidence.
    """
    names = ("vgx", "vgy", "pitch", "roll", "yaw")
    if any(name not in values for name in names) or len(stamps_s) < 50:
        return 0.0, ""
    columns = np.stack([values[name] for name in names], axis=1)
    good = np.isfinite(columns).all(axis=1)
    t, columns = stamps_s[good], columns[good]
    if len(t) < 50:
        return 0.0, ""
    lean = np.tan(np.radians(np.clip(np.stack([-columns[:, 2], columns[:, 3]], axis=1), -60.0, 60.0)))
    yaw = np.unwrap(np.radians(columns[:, 4]))
    if float(np.std(yaw)) < _MIN_TURN_RAD:
        return 0.0, ""
    span = max(2, round(_SPAN_S / max(float(np.median(np.diff(t))), 1e-3)))
    push = _turned(lean - np.median(lean, axis=0), yaw)
    world = _explained(t, columns[:, :2], push, span)
    body = _explained(t, _turned(columns[:, :2], yaw), push, span)
    independent = 2.0 * len(t) / span
    ratio = 0.5 * independent * math.log((1.0 - world) / (1.0 - body))
    words = (
        f"lean explains {100 * world:.0f} % of the changes of velocity if they are in world, {100 * body:.0f} % if in "
        "body axes"
    )
    return (ratio, words) if abs(ratio) >= _DECISIVE else (0.0, words)


def _turned(xy: FloatArray, yaw: FloatArray) -> FloatArray:
    """Horizontal vectors ``(M, 2)`` from the body's heading to the world's."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.stack([c * xy[:, 0] - s * xy[:, 1], s * xy[:, 0] + c * xy[:, 1]], axis=1)


def _explained(t: FloatArray, v: FloatArray, push: FloatArray, span: int) -> float:
    """Share of the changes of ``v`` ``(M, 2)`` over ``span`` readings that the mean ``push`` explains (one factor)."""
    dt = t[span:] - t[:-span]
    whole = dt < 2.0 * _SPAN_S
    change = (v[span:] - v[:-span])[whole] / dt[whole, None]
    total = np.concatenate([np.zeros((1, 2)), np.cumsum(push, axis=0)])
    mean = ((total[span:] - total[:-span])[: len(dt)] / span)[whole]
    change, mean = change - change.mean(axis=0), mean - mean.mean(axis=0)
    power, own = float(np.sum(mean**2)), float(np.sum(change**2))
    if power <= 0 or own <= 0:
        return 0.0
    together = max(0.0, float(np.sum(mean * change)))  # accelerating against the lean is impossible
    return min(together**2 / (power * own), 0.999)
