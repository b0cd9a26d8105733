r"""Correction of the cost's bias towards translation by free depths: a rotating camera must not appear to move.

Refinement minimises over poses *and* depths. While depths rest on priors, its minimum is biased: under translation
every depth can fit its pixel's noise, under pure rotation none can. The minimum lies at a baseline at which one sigma
of depth moves a point by about a pixel, some centimetres in a room, although the camera never moved. The expected cost
is lower by the number of depths that the images determine there (the effective number of parameters, as of a ridge
regression),

.. math:: \sum_a \frac{I_a \sigma_a^2}{1 + I_a \sigma_a^2}

where the images have the information ``I_a`` on the anchor's inverse depth, whose prior has the standard deviation
``sigma_a``. Added to the cost, the sum removes the bias; it is constant where images determine the depths. ``I_a`` is a
quadratic form of the motions from the anchor's host to its observers, and the summand's tangent in ``I_a`` bounds it
from above: a prior on each of these motions, as in iteratively reweighted least squares. Far from the minimum that
tangent is flat. The steeper ``\log(1 + I_a \sigma_a^2)``, the price of marginalised depths, leads there first; alone
it would pull the scale of a map that rests on priors.
"""

from enum import IntEnum

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.problem import RelativePosePrior, WindowProblem
from edgeslam_torch.types import FloatArray, IntArray

MIN_Z = 1e-6
"""Nearest depth of an anchor [map units]."""


class Weight(IntEnum):
    """Slope of a summand, as a power of ``1 / (1 + I_a sigma_a^2)``."""

    NONE = 0
    """No term."""
    WIDE = 1
    """Of the logarithm, which has the wider basin of convergence."""
    EXACT = 2
    """Of the number of determined depths."""


def motion_priors(problem: WindowProblem, weight: Weight) -> tuple[RelativePosePrior, ...]:
    """Priors on the motions between hosts and observers of a window's anchors with depth priors, at the current poses.

    Their mean is zero translation; rotations are free.
    """
    priors = problem.depth_priors
    if priors is None or weight is Weight.NONE:
        return ()
    row = np.full(len(problem.p_w), -1, dtype=np.int64)
    row[priors.anchor] = np.arange(len(priors.anchor))
    prior = row[problem.obs_anchor]
    mine = np.flatnonzero((prior >= 0) & (priors.pose[prior] != problem.obs_pose))
    if len(mine) == 0:
        return ()
    prior, observer = prior[mine], problem.obs_pose[mine]
    host, poses = priors.pose[prior], len(problem.T_c_w)
    pair, group = np.unique(host * poses + observer, return_inverse=True)
    first, second = pair // poses, pair % poses
    T_o_h = problem.T_c_w[second] @ se3.inverse(problem.T_c_w[first])
    slope = _slopes(problem, mine, host) * priors.sigma[prior][:, None, None]
    moved = (slope @ T_o_h[group, :3, 3:])[:, :, 0]
    gained = np.bincount(prior, (moved * moved).sum(1), len(priors.anchor))  # I sigma^2
    slope *= ((1.0 + gained[prior]) ** (-0.5 * weight))[:, None, None]
    information = np.zeros((len(pair), 6, 6))
    np.add.at(information[:, :3, :3], group, np.swapaxes(slope, 1, 2) @ slope)
    T_o_h[:, :3, 3] = 0.0
    return tuple(
        RelativePosePrior(int(i), int(j), T, omega)
        for i, j, T, omega in zip(first, second, T_o_h, information, strict=True)
    )


def _slopes(problem: WindowProblem, observation: IntArray, host: IntArray) -> FloatArray:
    """Derivative ``(O, 2, 3)`` of each whitened pixel by inverse depth in the host, per unit of translation."""
    observer, p = problem.obs_pose[observation], problem.p_w[problem.obs_anchor[observation]]
    T_c_w = problem.T_c_w
    p_o = (T_c_w[observer, :3, :3] @ p[:, :, None])[:, :, 0] + T_c_w[observer, :3, 3]
    z_host = (T_c_w[host, 2, :3] * p).sum(1) + T_c_w[host, 2, 3]
    z = np.maximum(p_o[:, 2], MIN_Z)
    slope = np.zeros((len(p), 2, 3))
    slope[:, 0, 0] = slope[:, 1, 1] = 1.0
    slope[:, :, 2] = -p_o[:, :2] / z[:, None]
    scale = problem.inv_sigma[observation] * np.maximum(z_host, MIN_Z) / z
    return slope * (np.array(problem.K[:2]) * scale[:, None])[:, :, None]
