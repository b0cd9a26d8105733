r"""Metric scale of a monocular map with its uncertainty, from displacements, height and predicted depth.

The essential matrix leaves translation without length and the paper never says how metres enter. Here each source
gives :math:`\log s` (metres per map unit) with a standard deviation, and the three are fused in the log domain.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry.robust_statistics import RMS_MEDIAN_3DOF, median, robust_sigma, tukey_weight
from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.types import FloatArray, IntArray, ScaleEstimate

_HUBER = 2.5
"""Residual from which on its weight falls [sigmas]."""
_MIN_DISPLACEMENTS = 6
"""18 measurements for 7 unknowns: scale, rotation, one bias."""


@dataclass(frozen=True, slots=True)
class LogScale:
    """One source's estimate of the logarithm of metres per map unit."""

    log_scale: float
    sigma: float
    source: str


@dataclass(frozen=True, slots=True)
class DisplacementFit:
    """Result of `fit_displacements`."""

    log_scale: float
    sigma: float
    rotation: FloatArray
    """``(3, 3)`` small correction of the map-to-world rotation."""
    rotation_sigma_rad: FloatArray
    """``(3,)`` standard deviations of it, about x, y, z."""
    bias_m_s: FloatArray
    """``(K, 3)`` velocity bias of each block."""
    rms_m: float
    """Residual per axis."""
    intervals: int
    """Displacements used."""


def fit_displacements(
    moved_map: FloatArray,
    moved_m: FloatArray,
    duration_s: FloatArray,
    sigma_map: FloatArray,
    sigma_m: FloatArray,
    block: IntArray,
    alignment_sigma_rad: float,
    bias_sigma_m_s: float,
    bias_step_m_s: float,
    iterations: int = 12,
) -> DisplacementFit | None:
    r"""Scale between visual and telemetry displacements of the same intervals, both of them noisy.

    Model: :math:`d_i = s \exp(\delta)\, u_i + b_{k(i)} L_i + \epsilon_i` with visual noise on :math:`u_i`: maximum
    likelihood for a line with errors in both variables (York 1968), three axes at once, Tukey weights. Plain least
    squares would shrink ``s`` by the share of noise in ``u``.

    Args:
        moved_map: Visual displacements turned to world axes [map units], shape ``(N, 3)``.
        moved_m: Telemetry displacements [m], shape ``(N, 3)``.
        duration_s: Length of the intervals [s], shape ``(N,)``.
        sigma_map: Standard deviation of ``moved_map`` per axis, shape ``(N,)``.
        sigma_m: Expected standard deviation of ``moved_m`` per axis, shape ``(N,)``.
        block: Index of the velocity bias that holds in the interval, from 0, shape ``(N,)``.
        alignment_sigma_rad: Prior on the rotation correction.
        bias_sigma_m_s: Prior on the first velocity bias.
        bias_step_m_s: Prior on the change from one block's bias to the next.
        iterations: Reweighting steps.

    Returns:
        The fit, or ``None`` when there are too few displacements or they carry no motion.
    """
    n = len(moved_map)
    if n < _MIN_DISPLACEMENTS:
        return None
    scale = math.sqrt(float(np.sum(moved_m**2)) / max(float(np.sum(moved_map**2)), 1e-30))
    if not (math.isfinite(scale) and scale > 1e-9):
        return None
    log_scale, K = math.log(scale), int(block.max()) + 1
    R, bias = np.eye(3), np.zeros((K, 3))
    sigma_map = np.minimum(sigma_map, 0.3 * math.sqrt(float(np.mean(moved_map**2))))
    spread = 1.0
    prior = _prior(K, alignment_sigma_rad, bias_sigma_m_s, bias_step_m_s)
    information = np.eye(4 + 3 * K)
    for iteration in range(iterations):
        scale = math.exp(log_scale)
        turned = moved_map @ R.T
        residual = moved_m - scale * turned - bias[block] * duration_s[:, None]
        variance = sigma_m**2 + (scale * sigma_map) ** 2
        normalised = np.sqrt(np.sum(residual**2, axis=1) / (3.0 * variance))
        if iteration < 3:  # Huber first: Tukey needs a start inside its basin
            spread = max(robust_sigma(normalised) / 1.4, 0.3)
            weight = np.minimum(1.0, _HUBER * spread / np.maximum(normalised, 1e-12))
        else:
            spread = max(median(normalised) / RMS_MEDIAN_3DOF, 0.3)
            weight = tukey_weight(normalised, spread)
        latent = turned + (scale * sigma_map**2 / variance)[:, None] * residual  # where the true displacement lies
        J, J_latent = (_jacobian(scale * v, duration_s, block, K) for v in (turned, latent))
        w = np.repeat(weight / (variance * spread**2), 3)
        theta = np.concatenate([[0.0], _small_rotation(R), bias.ravel()])
        information = (J_latent * w[:, None]).T @ J + prior
        step = np.linalg.solve(information, J_latent.T @ (w * residual.ravel()) - prior @ theta)
        log_scale += float(np.clip(step[0], -0.5, 0.5))
        R = _rotation(step[1:4]) @ R
        bias += step[4:].reshape(K, 3)
    if not (math.isfinite(log_scale) and np.all(np.isfinite(bias))):
        return None
    effective = _effective_share(residual * weight[:, None])
    covariance = np.linalg.inv(0.5 * (information + information.T))
    sigma = math.sqrt(max(float(covariance[0, 0]), 0.0) / effective)
    turn_sigma = np.sqrt(np.maximum(np.diag(covariance)[1:4], 0.0) / effective)
    rms = math.sqrt(float(np.sum(weight[:, None] * residual**2) / max(3.0 * float(weight.sum()), 1e-9)))
    if weight.sum() < _MIN_DISPLACEMENTS or not math.isfinite(sigma):
        return None
    return DisplacementFit(log_scale, sigma, R, turn_sigma, bias, rms, n)


def _prior(K: int, alignment_sigma_rad: float, bias_sigma_m_s: float, bias_step_m_s: float) -> FloatArray:
    """Information of (log s, rotation, biases) before any displacement: the biases are a random walk."""
    difference = np.eye(K) - np.eye(K, k=-1)
    sigma = np.full(K, bias_step_m_s)
    sigma[0] = bias_sigma_m_s
    walk = difference.T @ np.diag(sigma**-2) @ difference
    information = np.zeros((4 + 3 * K, 4 + 3 * K))
    information[range(1, 4), range(1, 4)] = alignment_sigma_rad**-2
    information[4:, 4:] = np.kron(walk, np.eye(3))
    return information


def _jacobian(moved: FloatArray, duration_s: FloatArray, block: IntArray, K: int) -> FloatArray:
    """Derivative of the prediction by (log s, rotation, biases), shape ``(3 N, 4 + 3 K)``."""
    n = len(moved)
    J = np.zeros((n, 3, 4 + 3 * K))
    J[:, :, 0] = moved
    J[:, :, 1:4] = -hat(moved)
    for axis in range(3):
        J[np.arange(n), axis, 4 + 3 * block + axis] = duration_s
    return J.reshape(3 * n, -1)


def _rotation(phi: FloatArray) -> FloatArray:
    """First-order rotation, orthonormalised; steps are a few degrees."""
    U, _, Vt = np.linalg.svd(np.eye(3) + hat(phi))
    return U @ Vt


def _small_rotation(R: FloatArray) -> FloatArray:
    return 0.5 * np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])


def _effective_share(residual: FloatArray) -> float:
    """Share of independent samples in a series ``(N, ...)`` from its lag-one correlation, in (0, 1]."""
    flat = residual.reshape(len(residual), -1)
    power = float(np.sum(flat**2))
    if len(flat) < 3 or power <= 0:
        return 1.0
    rho = float(np.clip(np.sum(flat[1:] * flat[:-1]) / power, 0.0, 0.9))
    return (1.0 - rho) / (1.0 + rho)


def floor_segments(stamp_s: FloatArray, z_m: FloatArray, z_predicted_m: FloatArray, step_m: float) -> IntArray:
    """Number the stretches between floor steps (furniture passing below), shape ``(N,)``.

    A step is a change between neighbours that differs from the predicted change by more than ``step_m``, or a hole of
    more than half a second.
    """
    if len(z_m) == 0:
        return np.zeros(0, dtype=np.int64)
    jump = np.abs(np.diff(z_m) - np.diff(z_predicted_m)) > step_m
    hole = np.diff(stamp_s) > 0.5
    return np.concatenate([[0], np.cumsum(jump | hole)]).astype(np.int64)


def fuse(opinions: Sequence[LogScale]) -> ScaleEstimate:
    """Information-weighted mean of independent estimates; sigma grows with their disagreement."""
    if not opinions:
        return ScaleEstimate()
    log_scale = np.array([o.log_scale for o in opinions])
    weight = np.array([o.sigma for o in opinions]) ** -2.0
    mean = float(np.sum(weight * log_scale) / np.sum(weight))
    sigma = float(np.sum(weight)) ** -0.5
    if len(opinions) > 1:  # Birge ratio: estimates that disagree beyond their sigmas widen the result
        birge = math.sqrt(float(np.sum(weight * (log_scale - mean) ** 2)) / (len(opinions) - 1))
        sigma *= max(1.0, birge)
    names = dict.fromkeys(o.source for o in opinions)
    value = math.exp(mean)
    return ScaleEstimate(value, value * sigma, "+".join(names))
