r"""Pre-integration of inertial readings between two moments (Forster, Carlone, Dellaert, Scaramuzza 2017).

Between moments :math:`i` and :math:`j` the readings, less their biases, give a rotation :math:`\Delta R`, a velocity
:math:`\Delta v` and a position :math:`\Delta p` in the axes of the IMU at :math:`i`, that do not depend on its state:

.. math::
    R_j = R_i\,\Delta R, \quad v_j = v_i + g\,\Delta t + R_i\,\Delta v, \quad
    p_j = p_i + v_i\,\Delta t + \tfrac12 g\,\Delta t^2 + R_i\,\Delta p .

Readings are linear between their stamps. A step takes the mean of its ends, and rotates the acceleration at its middle:
at 1 rad/s and 200 Hz the rotation at its start would turn gravity by 25 mm/s^2.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.types import FloatArray

MAX_GAP_S = 0.05
"""Longest time between two readings that is integrated across: ten at 200 Hz. At 1 m/s^2 and 1 rad/s of change in it,
the velocity is off by 12 mm/s."""

HELD_S = 0.011
"""Time for which the first and the last reading are held, two periods at 200 Hz: the reading of a frame's moment may
come with the next frame."""


@dataclass(frozen=True, slots=True)
class Preintegrated:
    """Increments over ``K`` intervals, linearised at a bias. Error order: rotation (right), velocity, position."""

    dt_s: FloatArray
    """``(K,)``"""
    R: FloatArray
    """``(K, 3, 3)``"""
    v: FloatArray
    """``(K, 3)`` [m/s]."""
    p: FloatArray
    """``(K, 3)`` [m]."""
    covariance: FloatArray
    """``(K, 9, 9)``"""
    by_bias: FloatArray
    """``(K, 9, 6)`` derivatives by the biases of gyroscope and accelerometer."""
    bias: FloatArray
    """``(6,)`` biases at which they hold [rad/s, m/s^2]."""
    complete: NDArray[np.bool_]
    """``(K,)`` whether readings cover the interval, none of them clipped."""


def preintegrate(
    readings: ImuReadings, edges_s: FloatArray, bias: FloatArray, model: ImuModel, range_ends: FloatArray | None = None
) -> Preintegrated:
    """Increments between successive moments.

    Args:
        readings: Of gyroscope and accelerometer.
        edges_s: Increasing moments ``(K + 1,)`` on their clock.
        bias: Of gyroscope and accelerometer ``(6,)``, subtracted.
        model: Noise densities.
        range_ends: As `ImuReadings.range_ends`: an interval with a clipped reading is not complete.
    """
    stamps_s = readings.stamps_s
    values = np.column_stack([readings.angular_rate_rad_s, readings.acceleration_m_s2])
    held_s = np.concatenate([stamps_s[:1] - HELD_S, stamps_s, stamps_s[-1:] + HELD_S])
    noise = model.gyroscope_noise_density**2, model.accelerometer_noise_density**2
    found = _preintegrate(held_s, np.concatenate([values[:1], values, values[-1:]]), edges_s, bias, *noise, MAX_GAP_S)
    complete = found[-1]
    if range_ends is not None and np.isfinite(range_ends).any():
        clipped = np.concatenate([[0], np.cumsum((np.abs(values) >= range_ends).any(axis=1))])
        first, last = np.searchsorted(stamps_s, edges_s[:-1]) - 1, np.searchsorted(stamps_s, edges_s[1:]) + 1
        complete &= clipped[np.minimum(last, len(values))] == clipped[np.maximum(first, 0)]
    return Preintegrated(np.diff(edges_s), *found[:-1], bias.copy(), complete)


@compiled()
def _product(A: FloatArray, B: FloatArray) -> FloatArray:
    """``A @ B`` in loops: numba's own loads all of SciPy."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@compiled()
def _exp(w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation of a vector ``(3,)``, and its right Jacobian."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    if angle < 1e-4:
        a, b, c = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    else:
        a, b, c = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2, (1.0 - np.sin(angle) / angle) / angle2
    W = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    square = _product(W, W)
    return np.eye(3) + a * W + b * square, np.eye(3) - b * W + c * square


@compiled("f8[::1], f8[:,::1], f8[::1], f8[::1], f8, f8, f8")
def _preintegrate(
    stamps_s: FloatArray,
    readings: FloatArray,
    edges_s: FloatArray,
    bias: FloatArray,
    gyroscope_psd: float,
    accelerometer_psd: float,
    max_gap_s: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    count = len(edges_s) - 1
    all_R, all_v, all_p = np.zeros((count, 3, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    all_covariance, all_by_bias = np.zeros((count, 9, 9)), np.zeros((count, 9, 6))
    complete = np.zeros(count, dtype=np.bool_)
    psd = np.repeat(np.array([gyroscope_psd, accelerometer_psd]), 3)
    n = 0
    for k in range(count):
        R, v, p = np.eye(3), np.zeros(3), np.zeros(3)
        covariance, by_bias = np.zeros((9, 9)), np.zeros((9, 6))
        while n + 1 < len(stamps_s) and stamps_s[n + 1] <= edges_s[k]:
            n += 1
        covered = len(stamps_s) > 1 and stamps_s[0] <= edges_s[k] and stamps_s[-1] >= edges_s[k + 1]
        m = n
        while covered and m + 1 < len(stamps_s) and stamps_s[m] < edges_s[k + 1]:
            long_s = stamps_s[m + 1] - stamps_s[m]
            start, end = max(stamps_s[m], edges_s[k]), min(stamps_s[m + 1], edges_s[k + 1])
            covered = long_s <= max_gap_s
            share = (0.5 * (start + end) - stamps_s[m]) / long_s
            mean = readings[m] + share * (readings[m + 1] - readings[m]) - bias
            m += 1
            h = end - start
            if h <= 0.0:
                continue
            w, a = mean[:3], mean[3:]
            E, right = _exp(w * h)
            E_half, right_half = _exp(w * (0.5 * h))
            R_half = _product(R, E_half)
            A = np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
            turned = -_product(R_half, A)  # acceleration by the rotation at the middle of the step
            F, G = np.eye(9), np.zeros((9, 6))
            F[:3, :3] = E.T
            F[3:6, :3] = h * _product(turned, E_half.T)
            F[6:, :3] = 0.5 * h * F[3:6, :3]
            G[:3, :3] = -h * right
            G[3:6, :3] = -0.5 * h * h * _product(turned, right_half)
            G[3:6, 3:] = -h * R_half
            G[6:, :] = 0.5 * h * G[3:6, :]
            for i in range(3):
                F[6 + i, 3 + i] = h
            by_bias = _product(F, by_bias) + G
            covariance = _product(_product(F, covariance), F.T) + _product(G * (psd / h), G.T)
            a_start = _product(R_half, a.reshape(3, 1))[:, 0]
            p += h * v + 0.5 * h * h * a_start
            v += h * a_start
            R[:] = _product(R, E)
        all_R[k], all_v[k], all_p[k] = R, v, p
        all_covariance[k], all_by_bias[k], complete[k] = covariance, by_bias, covered
    return all_R, all_v, all_p, all_covariance, all_by_bias, complete
