"""Whether a log's velocities are in the world of power-on or in the body's axes: told by how the drone leans.

A multicopter accelerates where it leans. In the right frame the lean explains the changes of velocity best.
"""

import math
from collections.abc import Mapping

import numpy as np

from edgeslam_torch.types import FloatArray

_SPAN_S = 0.5
"""Change of velocity and mean lean over so long."""
_LEAST_TURN_RAD = math.radians(20.0)
"""Without turning both frames are the same but for a constant."""
_DECISIVE = 3.0
"""Log likelihood ratio that is believed."""


def body_frame_evidence(stamps_s: FloatArray, values: Mapping[str, FloatArray]) -> tuple[float, str]:
    """Log likelihood ratio of "body axes" over "world of power-on", and the evidence in words.

    Args:
        stamps_s: ``(M,)`` increasing.
        values: SDK name to ``(M,)`` in the SDK's units; ``vgx vgy pitch roll yaw`` are needed.

    Returns:
        0 when the flight does not tell.
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
    if float(np.std(yaw)) < _LEAST_TURN_RAD:
        return 0.0, ""
    span = max(2, round(_SPAN_S / max(float(np.median(np.diff(t))), 1e-3)))
    shares = {}
    for name, turn in (("world", yaw), ("body", np.zeros_like(yaw))):
        c, s = np.cos(turn), np.sin(turn)
        turned = np.stack([c * lean[:, 0] - s * lean[:, 1], s * lean[:, 0] + c * lean[:, 1]], axis=1)
        shares[name] = _explained(t, columns[:, :2], turned, span)
    world, body = shares["world"], shares["body"]
    independent = 2.0 * len(t) / span
    ratio = 0.5 * independent * math.log((1.0 - world) / (1.0 - body))
    words = f"lean explains {100 * world:.0f} % of the changes of velocity in world, {100 * body:.0f} % in body axes"
    return (ratio, words) if abs(ratio) >= _DECISIVE else (0.0, words)


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
    together = max(0.0, float(np.sum(mean * change)))  # a drone that accelerates against its lean does not fly
    return min(together**2 / (power * own), 0.999)
