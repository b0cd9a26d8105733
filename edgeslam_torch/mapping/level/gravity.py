"""Where up is by an accelerometer: its mean force, turned into the map by the visual poses; and with edges."""

import math

import numpy as np

from edgeslam_torch.geometry.level import SpecificForce, Up
from edgeslam_torch.types import FloatArray

_G_M_S2 = 9.81
_OFF = 0.15
"""Relative deviation of a mean force from gravity beyond which it is none: another unit, or a fall."""
_MIN_S = 0.5
"""Time that a mean needs."""
_MAX_GAP_S = 0.2
"""Pose further from a reading than this does not turn it."""
_MAX_SIGMA = math.radians(8.0)
"""Less sure than this tells nothing."""
_CONTRADICTION = 3.0
"""Sigmas between gravity and edges beyond which one of them is wrong."""


def up_by_gravity(force: SpecificForce, stamps_s: FloatArray, T_w_c: FloatArray) -> Up | None:
    """Where up is in a map; None where the readings do not tell.

    The mean force is gravity's reaction and the mean acceleration, which is the change of velocity over the time. That
    one is unknown without metres; how much the halves of the time disagree stands for it.

    Args:
        force: Readings.
        stamps_s: ``(F,)`` stamps of the poses.
        T_w_c: ``(F, 4, 4)``.
    """
    if len(stamps_s) < 2:
        return None
    at = np.searchsorted(stamps_s, force.stamps_s).clip(1, len(stamps_s) - 1)
    at -= force.stamps_s - stamps_s[at - 1] < stamps_s[at] - force.stamps_s
    near = np.abs(stamps_s[at] - force.stamps_s) < _MAX_GAP_S
    near &= np.isfinite(force.force_c).all(axis=1)
    if near.sum() < 10 or float(np.ptp(force.stamps_s[near])) < _MIN_S:
        return None
    felt_w = np.einsum("nij,nj->ni", T_w_c[at[near], :3, :3], force.force_c[near])
    mean = felt_w.mean(axis=0)
    g = float(np.linalg.norm(mean))
    if abs(g / _G_M_S2 - 1.0) > _OFF:
        return None
    first, second = (half.mean(axis=0) for half in np.array_split(felt_w, 2))
    spread = float(np.linalg.norm(np.cross(first, second))) / (2.0 * g * g)
    sigma = math.hypot(force.sigma_rad, spread)
    return Up(mean / g, sigma, "accelerometer") if sigma < _MAX_SIGMA else None


def best_known(by_gravity: Up | None, by_edges: Up | None) -> Up | None:
    """Where up is by both; by the surer one, if that is an accelerometer and they contradict each other."""
    if by_gravity is None or by_edges is None:
        return by_gravity or by_edges
    sigma = math.hypot(by_gravity.sigma_rad, by_edges.sigma_rad)
    apart = math.acos(float(np.clip(by_gravity.direction @ by_edges.direction, -1.0, 1.0)))
    if apart > _CONTRADICTION * sigma:
        return by_gravity  # edges take one axis of a room for another; gravity does not
    weights = np.array([by_gravity.sigma_rad, by_edges.sigma_rad]) ** -2.0
    both = weights[0] * by_gravity.direction + weights[1] * by_edges.direction
    return Up(both / np.linalg.norm(both), float(weights.sum()) ** -0.5, "accelerometer+edges")
