r"""Scale, gravity, velocities and biases from visual poses beside an IMU: one maximum a posteriori estimate.

Nodes some 0.1 s apart have a rotation, position, velocity and biases of the IMU in metres, in the map's axes; common to
all are the log of metres per map unit, gravity, and the camera on the IMU. Pre-integrated readings relate successive
nodes (`preintegration`), biases walk, and the poses of the images are observed with an error :math:`e` that is
correlated in time,

.. math:: e_{k+1} = \rho_k e_k + \epsilon, \quad \rho_k = \exp(-\Delta t / \tau), \quad
    \epsilon \sim N(0, \sigma^2 (1 - \rho_k^2)):

with independent errors the stated scale would be too certain by half, with a random walk the shape of the whole way
would say nothing. The errors' size is estimated along with the states. Gauss-Newton; the nodes form a band, which is
eliminated.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.estimation.inertial.preintegration import Preintegrated, preintegrate
from edgeslam_torch.geometry.rotations import matrices_from_vectors, rotated, vectors_from_matrices
from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.noise import (
    FAST_M_S,
    GRAVITY_M_S2,
    IMU_AXES_RAD,
    IMU_BIAS_SIGMA,
    IMU_SCALE_LOG,
    IMU_YOUNG_LOG,
    IMU_YOUNG_S,
    KNOWN_LEVER_M,
    KNOWN_MOUNT_RAD,
    KNOWN_OFFSET_S,
    UNKNOWN_LEVER_M,
    UNKNOWN_MOUNT_RAD,
    UNKNOWN_OFFSET_S,
    VISUAL_MEMORY_S,
)
from edgeslam_torch.types import FloatArray

LEAST_NODES = 6
"""Minimum number of nodes, half a second."""
_STEPS, _METRIC_STEPS = 12, 4
"""Iterations; the first ones linear in the scale itself, whose start is arbitrary."""
_CONVERGED, _LARGEST_LOG = 0.05, 20.0
"""Change of what is common to all nodes, in sigmas, at which the iteration ends; a log scale that has diverged."""
_OUTLIER = 4.0
"""Error of one pose (6 numbers) from which on it counts linearly [standard deviations]: one in a hundred."""
_FLOOR_RAD, _FLOOR_SHARE = 1e-4, 1e-4
"""Least standard deviation of visual rotations, and of positions as a share of the extent of the way."""
_START_RAD, _START_SHARE = 3e-3, 0.02
"""The same at the start of the iteration."""
_NODE, _COMMON = 15, 10
_SCALE, _GRAVITY, _MOUNT, _LEVER, _OFFSET = 0, slice(1, 3), slice(3, 6), slice(6, 9), 9


@dataclass(frozen=True, slots=True)
class Alignment:
    """Estimate of one flight's last seconds. Node arrays are at the stamps of images."""

    stamps_s: FloatArray
    """``(N,)``"""
    R_m_i: FloatArray
    """``(N, 3, 3)`` IMU to map."""
    p_m_i: FloatArray
    """``(N, 3)`` IMU in the map's axes [m]."""
    velocity: FloatArray
    """``(N, 3)`` in the map's axes [m/s]."""
    bias: FloatArray
    """``(N, 6)`` of gyroscope and accelerometer [rad/s, m/s^2]."""
    log_scale: float
    """Log of metres per map unit."""
    gravity: FloatArray
    """``(3,)`` in the map's axes, downwards [m/s^2]."""
    R_i_c: FloatArray
    """``(3, 3)`` camera to IMU."""
    t_i_c: FloatArray
    """``(3,)`` camera in the IMU's axes [m]."""
    offset_s: float
    """``t_imu = t_cam + offset``"""
    covariance: FloatArray
    """``(10, 10)`` of log scale, gravity's direction (2) [rad], mount (3) [rad], lever (3) [m], offset [s]."""
    sigma_pose: tuple[float, float]
    """Standard deviations of the errors of visual poses [rad, map units]."""
    extent: float = 0.0
    """Root mean square distance of the nodes from their mean [map units]."""
    excitation: float = 0.0
    """Root mean square of the changing acceleration between nodes, in standard deviations of the accelerometer's noise:
    near 1 nothing but noise has moved, and the covariance of the scale means nothing."""

    @property
    def sigma_log_scale(self) -> float:
        """Standard deviation of the log scale."""
        young = IMU_YOUNG_LOG / (1.0 + ((self.stamps_s[-1] - self.stamps_s[0]) / IMU_YOUNG_S) ** 2)
        systematic = math.hypot(IMU_SCALE_LOG, young)
        return math.hypot(math.sqrt(self.covariance[_SCALE, _SCALE]), systematic)

    @property
    def sigma_up_rad(self) -> float:
        """Standard deviation of the vertical per axis."""
        return math.hypot(math.sqrt(0.5 * float(np.trace(self.covariance[_GRAVITY, _GRAVITY]))), IMU_AXES_RAD)

    @property
    def sigma_offset_s(self) -> float:
        """Standard deviation of the time offset."""
        return math.sqrt(self.covariance[_OFFSET, _OFFSET])

    @property
    def sigma_mount_rad(self) -> float:
        """Standard deviation of the camera's rotation on the IMU per axis."""
        return math.sqrt(float(np.trace(self.covariance[_MOUNT, _MOUNT])) / 3.0)


def align(
    stamps_s: FloatArray,
    T_m_c: FloatArray,
    readings: ImuReadings,
    model: ImuModel,
    mount: tuple[FloatArray, float],
    before: Alignment | None = None,
    range_ends: FloatArray | None = None,
) -> Alignment | None:
    """Align visual poses with inertial readings.

    Args:
        stamps_s: Increasing stamps of images ``(N,)``, about 0.1 s apart.
        T_m_c: Their poses ``(N, 4, 4)`` in one submap.
        readings: Readings that cover them, on the IMU's clock.
        model: Noise, and what is known of mount and clock.
        mount: Rotation camera to IMU ``(3, 3)`` and time offset [s], as known or by `imu_mount`.
        before: An earlier result in the same map, to start from.
        range_ends: As for `preintegrate`.

    Returns:
        The estimate, whether or not its scale is accurate; None if readings do not cover enough nodes, or the
        iteration fails.
    """
    if len(stamps_s) < LEAST_NODES:
        return None
    known = model.T_imu_cam
    lever = np.zeros(3) if known is None else known[:3, 3]
    offset_s = mount[1] if before is None else before.offset_s
    bias = np.zeros(6) if before is None else before.bias[-1]
    rates, moments = readings.angular_rate_rad_s, stamps_s + offset_s
    pre = preintegrate(readings, moments, bias, model, range_ends)
    R_m_c, z = T_m_c[:, :3, :3], T_m_c[:, :3, 3]
    extent = float(np.sqrt(np.mean(np.sum((z - z.mean(axis=0)) ** 2, axis=1))))
    if pre.complete.sum() < LEAST_NODES - 1 or extent <= 0.0:
        return None
    rate = np.stack([np.interp(moments, readings.stamps_s, rates[:, k]) for k in range(3)], axis=1)
    x = _initial(stamps_s, R_m_c, z, pre, (*mount, lever) if before is None else before, extent)
    there = pre.complete[:, None, None]  # across a gap of the readings only images relate two nodes
    whiten = there * np.linalg.inv(np.linalg.cholesky(np.where(there, pre.covariance, np.eye(9))))
    walk = np.repeat([model.gyroscope_random_walk, model.accelerometer_random_walk], 3)
    floor = _FLOOR_RAD, _FLOOR_SHARE * extent
    mount_rad, lever_m = (UNKNOWN_MOUNT_RAD, UNKNOWN_LEVER_M) if known is None else (KNOWN_MOUNT_RAD, KNOWN_LEVER_M)
    clock_s = UNKNOWN_OFFSET_S if model.time_offset_s is None else KNOWN_OFFSET_S
    sigma_known = np.array([mount_rad] * 3 + [lever_m] * 3 + [clock_s])
    metric_steps = _METRIC_STEPS if before is None else 0
    for step in range(_STEPS):
        metric = step < metric_steps
        deviation = np.concatenate(
            [
                vectors_from_matrices(mount[0].T @ x.R_i_c),
                x.t_i_c - lever,
                [x.offset_s - mount[1]],
            ]
        )
        system = _linearised(x, R_m_c, z, pre, whiten, walk, rate, offset_s, metric)
        try:
            by_node, by_all, covariance = _solved(*system, x.bias[0], deviation, sigma_known)
        except np.linalg.LinAlgError:
            return None
        x = _moved(x, by_node, by_all, metric)
        x = replace(x, covariance=covariance, sigma_pose=_error_sizes(x, R_m_c, z, pre.dt_s, floor, offset_s))
        if not (np.isfinite(by_all).all() and (np.diag(covariance) > 0.0).all()) or abs(x.log_scale) > _LARGEST_LOG:
            return None
        if step > metric_steps and (np.abs(by_all) < _CONVERGED * np.sqrt(np.diag(covariance))).all():
            break
    dt_s = pre.dt_s[pre.complete, None]
    acceleration = np.diff(x.velocity, axis=0)[pre.complete] / dt_s
    noise_m_s2 = model.accelerometer_noise_density / np.sqrt(dt_s)
    return replace(
        x,
        extent=extent,
        excitation=float(np.sqrt(np.mean(((acceleration - acceleration.mean(axis=0)) / noise_m_s2) ** 2))),
    )


def _initial(
    stamps_s: FloatArray,
    R_m_c: FloatArray,
    z: FloatArray,
    pre: Preintegrated,
    start: Alignment | tuple[FloatArray, float, FloatArray],
    extent: float,
) -> Alignment:
    """State from an earlier result, or from a mount, offset and lever: then the gyroscope's bias by differences of
    rotations, and gravity by the mean specific force. Velocities by differences of positions."""
    bias = np.tile(pre.bias, (len(z), 1))
    if isinstance(start, Alignment):
        R_i_c, offset_s, lever = start.R_i_c, start.offset_s, start.t_i_c
        log_scale, gravity, sigma, R = start.log_scale, start.gravity, start.sigma_pose, R_m_c @ R_i_c.T
    else:
        R_i_c, offset_s, lever = start
        log_scale, sigma, R = 0.0, (_START_RAD, _START_SHARE * extent), R_m_c @ R_i_c.T
        deviation = vectors_from_matrices(_T(pre.R) @ _T(R[:-1]) @ R[1:])
        bias[:, :3] += np.linalg.lstsq(pre.by_bias[:, :3, :3].reshape(-1, 3), deviation.ravel(), rcond=None)[0]
        up = np.einsum("kij,kj->i", R[:-1], pre.v)
        gravity = -GRAVITY_M_S2 * up / np.linalg.norm(up)
    p = math.exp(log_scale) * z - R @ lever
    between = np.diff(p, axis=0) / pre.dt_s[:, None]
    velocity = np.concatenate([between[:1], 0.5 * (between[1:] + between[:-1]), between[-1:]])
    nothing = np.zeros((_COMMON, _COMMON))
    return Alignment(stamps_s, R, p, velocity, bias, log_scale, gravity, R_i_c, lever, offset_s, nothing, sigma)


def _errors(
    x: Alignment, R_m_c: FloatArray, z: FloatArray, offset_s: float, rate: FloatArray | None, metric: bool
) -> tuple[FloatArray, FloatArray]:
    """Errors ``(N, 6)`` of the visual poses, rotation in the camera and position in the map's axes, and the IMU's
    rotation at the moments of the images. ``metric``: in metres, linear in the scale, to start from far away."""
    late, scale = x.offset_s - offset_s, math.exp(x.log_scale)
    R = x.R_m_i if rate is None else x.R_m_i @ matrices_from_vectors((rate - x.bias[:, :3]) * late)
    centre = x.p_m_i + x.velocity * late + R @ x.t_i_c
    position = centre - scale * z if metric else centre / scale - z
    return np.concatenate([vectors_from_matrices(_T(R_m_c) @ R @ x.R_i_c), position], axis=1), R


def _error_sizes(
    x: Alignment, R_m_c: FloatArray, z: FloatArray, dt_s: FloatArray, floor: tuple[float, float], offset_s: float
) -> tuple[float, float]:
    """Robust standard deviations of the errors of visual poses."""
    e, _ = _errors(x, R_m_c, z, offset_s, None, metric=False)
    rho = np.exp(-dt_s / VISUAL_MEMORY_S)[:, None]
    new = (e[1:] - rho * e[:-1]) / np.sqrt(1.0 - rho**2)
    sizes = [1.4826 * float(np.median(np.abs(part))) for part in (new[:, :3], new[:, 3:])]
    return max(sizes[0], floor[0]), max(sizes[1], floor[1])


def _linearised(
    x: Alignment,
    R_m_c: FloatArray,
    z: FloatArray,
    pre: Preintegrated,
    whiten: FloatArray,
    walk: FloatArray,
    rate: FloatArray,
    offset_s: float,
    metric: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Whitened residuals ``(K, 21)`` of the intervals with their derivatives ``(K, 21, 40)`` by both nodes and what is
    common; and those of the first pose, ``(6,)`` and ``(6, 25)``."""
    dt, K, N = pre.dt_s, len(pre.dt_s), len(z)
    first, second, common = np.s_[:_NODE], np.s_[_NODE : 2 * _NODE], 2 * _NODE
    J, r = np.zeros((K, 21, common + _COMMON)), np.zeros((K, 21))
    h, I3 = dt[:, None], np.eye(3)
    R0, R1, v0, v1 = x.R_m_i[:-1], x.R_m_i[1:], x.velocity[:-1], x.velocity[1:]
    R0_T, by_gravity = _T(R0), GRAVITY_M_S2 * _across(x.gravity)
    changed = np.einsum("kij,kj->ki", pre.by_bias, x.bias[:-1] - pre.bias)
    sped = rotated(R0_T, v1 - v0 - x.gravity * h)
    went = rotated(R0_T, np.diff(x.p_m_i, axis=0) - v0 * h - 0.5 * x.gravity * h**2)
    r[:, :3] = vectors_from_matrices(_T(pre.R @ matrices_from_vectors(changed[:, :3])) @ R0_T @ R1)
    r[:, 3:6] = sped - pre.v - changed[:, 3:6]
    r[:, 6:9] = went - pre.p - changed[:, 6:]
    J[:, :3, :3], J[:, :3, 15:18] = -_T(R1) @ R0, I3
    J[:, 3:6, :3], J[:, 3:6, 6:9], J[:, 3:6, 21:24] = hat(sped), -R0_T, R0_T
    J[:, 6:9, :3], J[:, 6:9, 3:6], J[:, 6:9, 18:21] = hat(went), -R0_T, R0_T
    J[:, 6:9, 6:9] = -R0_T * h[:, :, None]
    J[:, :9, 9:15] = -pre.by_bias
    J[:, 3:6, common + 1 : common + 3] = -(R0_T @ by_gravity) * h[:, :, None]
    J[:, 6:9, common + 1 : common + 3] = -0.5 * (R0_T @ by_gravity) * h[:, :, None] ** 2
    r[:, :9], J[:, :9] = rotated(whiten, r[:, :9]), whiten @ J[:, :9]
    weight, six = 1.0 / (walk * np.sqrt(h)), np.arange(6)
    r[:, 9:15] = weight * np.diff(x.bias, axis=0)
    J[:, 9 + six, 9 + six], J[:, 9 + six, 24 + six] = -weight, weight

    e, R = _errors(x, R_m_c, z, offset_s, rate, metric)
    unit = 1.0 if metric else math.exp(-x.log_scale)
    E, C = np.zeros((N, 6, _NODE)), np.zeros((N, 6, _COMMON))
    late = x.offset_s - offset_s
    E[:, :3, :3], C[:, :3, _MOUNT] = x.R_i_c.T, I3
    C[:, :3, _OFFSET] = (rate - x.bias[:, :3]) @ x.R_i_c
    E[:, 3:, :3], E[:, 3:, 3:6] = -unit * R @ hat(x.t_i_c), unit * I3
    E[:, 3:, 6:9] = unit * late * I3
    C[:, 3:, _LEVER], C[:, 3:, _OFFSET] = unit * R, unit * x.velocity
    C[:, 3:, _SCALE] = -math.exp(x.log_scale) * z if metric else -(e[:, 3:] + z)
    sigma_r, sigma_t = x.sigma_pose
    weight = np.repeat([1.0 / sigma_r, math.exp(-x.log_scale) / sigma_t if metric else 1.0 / sigma_t], 3)
    rho = np.exp(-h / VISUAL_MEMORY_S)
    fresh = weight / np.sqrt(1.0 - rho**2)
    r[:, 15:] = fresh * (e[1:] - rho * e[:-1])
    fresh, kept = fresh[:, :, None], (fresh * rho)[:, :, None]
    J[:, 15:, first], J[:, 15:, second] = -kept * E[:-1], fresh * E[1:]
    J[:, 15:, common:] = fresh * C[1:] - kept * C[:-1]
    if not metric:  # Huber
        size = np.linalg.norm(r[:, 15:], axis=1)
        robust = np.sqrt(_OUTLIER / np.maximum(size, _OUTLIER))[:, None]
        r[:, 15:] *= robust
        J[:, 15:] *= robust[:, :, None]
    return J, r, weight[:, None] * np.concatenate([E[0], C[0]], axis=1), weight * e[0]


def _solved(
    J: FloatArray,
    r: FloatArray,
    J_first: FloatArray,
    r_first: FloatArray,
    bias: FloatArray,
    deviation: FloatArray,
    sigma_known: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Gauss-Newton step of nodes ``(N, 15)`` and of what is common ``(10,)``, with the latter's covariance."""
    n, N = _NODE, len(r) + 1
    H, g = _T(J) @ J, np.einsum("kij,ki->kj", J, r)
    own, border, slope = np.zeros((N, n, n)), np.zeros((N, n, _COMMON)), np.zeros((N, n))
    for nodes, at in ((np.s_[:-1], np.s_[:n]), (np.s_[1:], np.s_[n : 2 * n])):
        own[nodes] += H[:, at, at]
        border[nodes] += H[:, at, 2 * n :]
        slope[nodes] += g[:, at]
    corner, common = H[:, 2 * n :, 2 * n :].sum(axis=0), g[:, 2 * n :].sum(axis=0)
    H, g = J_first.T @ J_first, J_first.T @ r_first
    own[0] += H[:n, :n]
    border[0] += H[:n, n:]
    corner += H[n:, n:]
    slope[0] += g[:n]
    common = common + g[n:]
    six = np.arange(9, 15)
    own[:, 6 + np.arange(3), 6 + np.arange(3)] += FAST_M_S**-2
    own[0, six, six] += IMU_BIAS_SIGMA**-2
    slope[0, 9:] += IMU_BIAS_SIGMA**-2 * bias
    known = np.arange(3, _COMMON)
    corner[known, known] += sigma_known**-2
    common[known] += sigma_known**-2 * deviation
    coupling = _T(J[:, :, :n]) @ J[:, :, n : 2 * n]
    across = border.reshape(-1, _COMMON)
    solved = _block_tridiagonal(own, coupling, np.concatenate([border, slope[:, :, None]], axis=2))
    solved = solved.reshape(-1, _COMMON + 1)
    covariance = np.linalg.inv(corner - across.T @ solved[:, :-1])
    covariance = 0.5 * (covariance + covariance.T)
    by_all = -covariance @ (common - across.T @ solved[:, -1])
    return -(solved[:, -1] + solved[:, :-1] @ by_all).reshape(N, n), by_all, covariance


def _block_tridiagonal(own: FloatArray, coupling: FloatArray, right: FloatArray) -> FloatArray:
    """Solve a symmetric system of blocks on the diagonal ``(N, n, n)`` and beside it ``(N - 1, n, n)``, rows by columns
    of the next block, for right sides ``(N, n, m)`` (Thomas)."""
    n = own.shape[1]
    own, x = own.copy(), right.copy()
    by_next = np.empty_like(coupling)
    for k, C in enumerate(coupling):
        solved = np.linalg.solve(own[k], np.concatenate([C, x[k]], axis=1))
        by_next[k], x[k] = solved[:, :n], solved[:, n:]
        own[k + 1] -= C.T @ by_next[k]
        x[k + 1] -= C.T @ x[k]
    x[-1] = np.linalg.solve(own[-1], x[-1])
    for k in range(len(coupling) - 1, -1, -1):
        x[k] -= by_next[k] @ x[k + 1]
    return x


def _moved(x: Alignment, by_node: FloatArray, by_all: FloatArray, linear: bool) -> Alignment:
    """The state after a step; ``linear`` in the scale itself, which must stay positive."""
    grown = math.log(max(1.0 + by_all[_SCALE], 0.2)) if linear else float(np.clip(by_all[_SCALE], -0.7, 0.7))
    gravity = x.gravity + GRAVITY_M_S2 * _across(x.gravity) @ by_all[_GRAVITY]
    return replace(
        x,
        R_m_i=x.R_m_i @ matrices_from_vectors(by_node[:, :3]),
        p_m_i=x.p_m_i + by_node[:, 3:6],
        velocity=x.velocity + by_node[:, 6:9],
        bias=x.bias + by_node[:, 9:],
        log_scale=x.log_scale + grown,
        gravity=GRAVITY_M_S2 * gravity / np.linalg.norm(gravity),
        R_i_c=x.R_i_c @ matrices_from_vectors(by_all[_MOUNT]),
        t_i_c=x.t_i_c + by_all[_LEVER],
        offset_s=x.offset_s + by_all[_OFFSET],
    )


def _across(direction: FloatArray) -> FloatArray:
    """Two unit vectors at right angles to a direction, as columns ``(3, 2)``."""
    return np.linalg.svd(direction[None])[2][1:].T


def _T(R: FloatArray) -> FloatArray:
    return np.swapaxes(R, -1, -2)
