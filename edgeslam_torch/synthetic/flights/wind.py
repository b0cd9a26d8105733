"""What wind does to a hovering or flying drone: gusts push it off its path, and its controller leans against them."""

import numpy as np
from scipy.linalg import expm

from edgeslam_torch.types import FloatArray

STIFFNESS_S2, DAMPING_S = 3.0, 2.4
"""Acceleration by which a position controller answers, for a metre off its place and for a metre a second: it is back
after about two seconds and hardly overshoots."""
GUST_S = 1.2
"""Correlation time of gusts."""
VERTICAL = 0.4
"""Gusts up and down as a share of those to the sides."""
STEP_S = 0.01


def blown(
    rng: np.random.Generator, stamps_s: FloatArray, steady_m_s2: float, gust_m_s2: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where wind carries a drone that holds its place.

    Args:
        rng: Of the gusts and of the direction of the steady wind.
        stamps_s: ``(F,)`` increasing [s].
        steady_m_s2: Acceleration by the steady wind, level; the controller has long learnt to lean against it.
        gust_m_s2: Standard deviation of that by gusts, on each level axis.

    Returns:
        Displacement ``(F, 3)`` [m], its velocity [m/s], and the acceleration that the drone's lean makes [m/s^2].
    """
    count = int(np.ceil((stamps_s[-1] - stamps_s[0]) / STEP_S)) + 2
    times = stamps_s[0] + STEP_S * np.arange(count)
    keep = np.exp(-STEP_S / GUST_S)
    shocks = rng.normal(0.0, gust_m_s2 * np.sqrt(1.0 - keep**2), (count, 3)) * (1.0, 1.0, VERTICAL)
    gust = correlated(shocks, keep)
    state = np.zeros((count, 2, 3))
    A = np.array([[0.0, 1.0], [-STIFFNESS_S2, -DAMPING_S]])
    over_step = expm(A * STEP_S)
    pushed = np.linalg.solve(A, over_step - np.eye(2))[:, 1]
    for k in range(1, count):
        state[k] = over_step @ state[k - 1] + pushed[:, None] * gust[k - 1]
    towards = rng.uniform(0.0, 2.0 * np.pi)
    steady = steady_m_s2 * np.array([np.cos(towards), np.sin(towards), 0.0])
    lean = -STIFFNESS_S2 * state[:, 0] - DAMPING_S * state[:, 1] - steady
    sampled = [
        np.stack([np.interp(stamps_s, times, x[:, k]) for k in range(3)], 1) for x in (*state.swapaxes(0, 1), lean)
    ]
    return sampled[0], sampled[1], sampled[2]


def correlated(steps: FloatArray, keep: float) -> FloatArray:
    """Noise with a memory, from zero on: ``keep`` times the value before plus a step, along the first axis."""
    from scipy.signal import lfilter  # loads half of scipy

    return np.asarray(lfilter([1.0], [1.0, -keep], np.concatenate([0.0 * steps[:1], steps[1:]]), axis=0))
