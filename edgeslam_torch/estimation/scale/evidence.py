r"""Metric scale from velocities or heights, in a map whose scale may drift as much as the residuals show.

Unknowns are :math:`\theta = (s, s\,\delta)`: metres per map unit and a small rotation of the map against the drone's
world. Both kinds of measurement are linear in them:

.. math::
    d_i = s\,u_i + s\,\delta \times u_i + b_i L_i + \epsilon_i, \qquad
    h_j = s\,z_j + (s\,\delta \times p_j)_z + c_k + w_j + \epsilon_j

with velocity bias :math:`b` and drift of the visual position :math:`w` that decorrelate in seconds (Ornstein-Uhlenbeck;
only the drift's change over an interval counts, so that long paths weigh more than oscillations in place). Part of
:math:`w` goes with the camera's rotation, :math:`R_i a` with an unknown :math:`a`, and does not decorrelate.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.estimation.scale.belief import MOST_SIGMA, ScaleBelief
from edgeslam_torch.geometry.robust_statistics import RMS_MEDIAN_3DOF, median, robust_sigma, tukey_weight
from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.noise import (
    MAP_DRIFT_M,
    MAP_DRIFT_MEMORY_S,
    MAP_PIVOT_M,
    MAP_WANDER_LOG,
    VELOCITY_BIAS_M_S,
    VELOCITY_BIAS_MEMORY_S,
)
from edgeslam_torch.types import FloatArray, IntArray

_LEAST_WEIGHT = 1e-3
_MIN_EXPLAINED = 0.5
"""Minimum share of the visual path explained by the fit."""
MIN_DISPLACEMENTS = 6
_MIN_HEIGHTS = 4
_BELIEF = 20.0
"""Weight of the expected noise against the observed one, in residuals."""
_SELECTED_AT = 2
"""Iteration in which the map's scale drift is selected: by then the worst outliers are downweighted."""
_MOST_PARTS = 4
"""Maximum number of parts of a flight whose scales are compared; shorter parts are too noisy."""
_VIEW_RAD = math.radians(60.0)
"""Typical field of view."""
_LEAST_AGE_S = 1.0
"""Lower bound of the map's age."""
_BIN_S = 0.5
_SCALE, _THETA, _OFFSETS = 0, slice(0, 4), slice(4, None)
"""Slices of the vector of unknowns; heights append an offset per segment to theta."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """Information of one kind of measurement on ``theta`` ``(4,)``."""

    information: FloatArray
    """``(4, 4)``"""
    vector: FloatArray
    """``(4,)`` information times mean."""
    rms_m: float
    """RMS residual."""
    log_likelihood: float = 0.0
    """Of the displacements, up to a constant, for comparing models of the same data."""
    wander: float = MAP_WANDER_LOG[0]
    """Change of the map's log scale per e-fold of its age; estimated by displacements only."""
    noise_log: float = 0.0
    """Effect of the map's noise on the log scale: by how much the fit differs from plain least squares, or would if it
    were corrected for correlated noise."""
    torn: bool = False
    """Whether no single scale fits most of the visual path."""

    def softened(self, sigma: float) -> "Evidence":
        """The same with a systematic error of the scale [m per map unit]."""
        q = sigma**2
        column = self.information[:, _SCALE] * (q / (1.0 + q * float(self.information[_SCALE, _SCALE])))
        information = self.information - np.outer(column, self.information[_SCALE])
        return replace(self, information=information, vector=self.vector - column * self.vector[_SCALE])

    def solved(self, tilt_sigma_rad: float | FloatArray) -> tuple[float, float] | None:
        """Scale and relative standard deviation, with the rotation marginalised under its prior."""
        if not self.information[_SCALE, _SCALE] > 0:
            return None
        s = abs(float(self.vector[_SCALE] / self.information[_SCALE, _SCALE]))
        for _ in range(2):  # the prior on s delta needs s
            prior = _tilt_prior(max(s, 1e-12), tilt_sigma_rad)
            try:
                covariance = np.linalg.inv(self.information + prior)
            except np.linalg.LinAlgError:
                return None
            s = float((covariance @ self.vector)[_SCALE])
            if not (math.isfinite(s) and s > 1e-9 and covariance[_SCALE, _SCALE] > 0):
                return None
        return s, math.sqrt(float(covariance[_SCALE, _SCALE])) / s

    def belief(self, source: str, tilt_sigma_rad: float | FloatArray, systematic: float) -> ScaleBelief | None:
        """The scale with a relative systematic error added; None where it is hardly determined."""
        rough = self.solved(tilt_sigma_rad)
        found = None if rough is None else self.softened(systematic * rough[0]).solved(tilt_sigma_rad)
        if found is None or found[1] >= MOST_SIGMA:
            return None
        return ScaleBelief(math.log(found[0]), found[1], source)


def _tilt_prior(s: float, tilt_sigma_rad: float | FloatArray, offsets: int = 0) -> FloatArray:
    """Prior information on the unknowns: none on the scale, weak on offsets."""
    return np.diag([0.0, *np.broadcast_to((s * tilt_sigma_rad) ** -2, 3), *[1e-6] * offsets])


def displacement_evidence(
    moved_map: FloatArray,
    moved_m: FloatArray,
    from_s: FloatArray,
    duration_s: FloatArray,
    sigma_map: FloatArray,
    sigma_m: FloatArray,
    turned: FloatArray,
    tilt_sigma_rad: float | FloatArray,
    aged: FloatArray | None = None,
) -> Evidence | None:
    """Evidence from visual and telemetry displacements of the same intervals.

    Errors-in-variables regression: the regressor's partner is the most likely true displacement (York 1968). Ordinary
    least squares would shrink the scale by the share of noise.

    Args:
        moved_map: Visual displacements in world axes [map units], shape ``(N, 3)``.
        moved_m: Telemetry's [m], shape ``(N, 3)``.
        from_s: Starts of the intervals ``(N,)``.
        duration_s: Their lengths ``(N,)``.
        sigma_map: Standard deviation of ``moved_map`` per axis, shape ``(N,)``.
        sigma_m: Expected standard deviation of ``moved_m`` per axis, shape ``(N,)``.
        turned: Change of the camera's rotation ``R_w_c`` over each interval ``(N, 3, 3)``.
        tilt_sigma_rad: Prior on the rotation; ``(3,)``, about each axis, or one for all.
        aged: Log age of the map since each interval, see `aged_since`, ``(N,)``: estimates the present scale, with less
            weight on older intervals. None: a constant scale.
    """
    n = len(moved_map)
    length = float(np.sum(moved_map**2))
    if n < MIN_DISPLACEMENTS or not length > 0:
        return None
    sigma_map = np.minimum(sigma_map, 0.3 * math.sqrt(length / (3 * n)))
    lag_s = from_s[:, None] - from_s[None]
    memory = np.exp(-np.abs(lag_s) / VELOCITY_BIAS_MEMORY_S)
    bias = VELOCITY_BIAS_M_S**2 * memory * np.outer(duration_s, duration_s)
    s = math.sqrt(float(np.sum(moved_m**2)) / length)
    if not (math.isfinite(s) and s > 1e-9):
        return None
    drifting = _of_changes(lag_s, duration_s, MAP_DRIFT_MEMORY_S)
    pivoting = MAP_PIVOT_M**2 / 3.0 * np.einsum("iab,jab->ij", turned, turned)  # the mean over the axes
    wandering = 0.0 * bias if aged is None else s**2 * _common(aged) * (moved_map @ moved_map.T)
    J = np.concatenate([moved_map[:, :, None], -hat(moved_map)], axis=2).transpose(1, 0, 2)  # (3, N, 4)
    target = moved_m.T[:, :, None]  # (3, N, 1)
    weight: FloatArray = np.ones(n)
    wanders = (MAP_WANDER_LOG[0],) if aged is None else MAP_WANDER_LOG
    possible = [(a, c) for a in MAP_DRIFT_M for c in wanders]
    chosen = possible[0]
    latent = J
    fit: _Fit | None = None
    for k in range(5):
        white = (sigma_m**2 + (s * sigma_map) ** 2) / np.maximum(weight, _LEAST_WEIGHT)
        prior = _tilt_prior(s, tilt_sigma_rad)
        likeliest = -math.inf
        for a, c in possible if k == _SELECTED_AT else [chosen]:
            slow = bias + pivoting + a**2 * drifting + c**2 * wandering
            found = _fitted(white, slow, J, latent, target, prior)
            if found is not None and found.log_likelihood > likeliest:
                fit, chosen, likeliest = found, (a, c), found.log_likelihood
        if fit is None or not fit.theta[_SCALE] > 1e-9:
            return None
        s = float(fit.theta[_SCALE])
        clean = fit.residual - fit.slow  # (3, N)
        variance = sigma_m**2 + (s * sigma_map) ** 2
        normalised = np.sqrt(np.sum(clean**2, axis=0) / (3.0 * variance))
        spread = max(median(normalised) / RMS_MEDIAN_3DOF, 0.3)
        weight = tukey_weight(normalised, spread)
        drift = fit.slow - fit.whitened @ bias  # the map's, so it is in the regressor as well
        partner = moved_map + ((s * sigma_map**2 / variance) * clean + drift / s).T
        latent = np.concatenate([partner[:, :, None], -hat(partner)], axis=2).transpose(1, 0, 2)
    if fit is None or float(weight.sum()) < MIN_DISPLACEMENTS:
        return None
    rms = math.sqrt(float(np.sum(weight * clean**2)) / max(3.0 * float(weight.sum()), 1e-9))
    torn = float(weight @ np.sum(moved_map**2, axis=1)) < _MIN_EXPLAINED * length
    slow = bias + pivoting + chosen[0] ** 2 * drifting + chosen[1] ** 2 * wandering
    covariance = slow + np.diag(sigma_m**2 + (s * sigma_map) ** 2)
    plain = _fitted(white, slow, J, J, target, prior)
    noise_log = math.log(s / float(plain.theta[_SCALE])) if plain is not None and plain.theta[_SCALE] > 0 else 0.0
    evidence = Evidence(fit.information, fit.vector, rms, fit.log_likelihood, chosen[1], noise_log, torn)
    return evidence.softened(_unrest(covariance, fit, J, latent, target))


def height_evidence(
    p_map: FloatArray,
    down_c: FloatArray,
    z_m: FloatArray,
    stamp_s: FloatArray,
    segment: IntArray,
    sigma_map: float,
    sigma_m: float,
    scale: float,
    tilt_sigma_rad: float | FloatArray,
    aged: FloatArray | None = None,
    wander: float = MAP_WANDER_LOG[0],
) -> Evidence | None:
    """Evidence from height above the floor against visual height, with a free offset per segment without floor step.

    Args:
        p_map: Visual positions of the body, world axes (z up) [map units], shape ``(N, 3)``.
        down_c: The world's vertical in the camera's axes, either sign ``(N, 3)``.
        z_m: Measured height [m], shape ``(N,)``.
        stamp_s: Times ``(N,)``.
        segment: Segment number from `floor_segments`, shape ``(N,)``.
        sigma_map: Noise of ``p_map`` per axis.
        sigma_m: Expected noise of ``z_m``.
        scale: Rough metres per map unit.
        tilt_sigma_rad: Prior on the rotation; ``(3,)``, about each axis, or one for all.
        aged: As in `displacement_evidence`, ``(N,)``.
        wander: Change of the map's log scale per e-fold of its age, from the displacements.
    """
    if len(z_m) < 2 * _MIN_HEIGHTS:
        return None
    part = np.unique(np.stack([segment, ((stamp_s - stamp_s[0]) // _BIN_S).astype(int)]), axis=1, return_inverse=True)
    key, group = part[0], part[1].ravel()
    count = np.bincount(group).astype(np.float64)
    p, down = (np.stack([np.bincount(group, x[:, k]) / count for k in range(3)], axis=1) for x in (p_map, down_c))
    z, t = np.bincount(group, z_m) / count, np.bincount(group, stamp_s) / count
    stretch = np.unique(key[0], return_inverse=True)[1].ravel()
    kept = (np.bincount(stretch) >= _MIN_HEIGHTS)[stretch]
    if not kept.any():
        return None
    p, down, z, t, count, stretch = p[kept], down[kept], z[kept], t[kept], count[kept], stretch[kept]
    stretch = np.unique(stretch, return_inverse=True)[1].ravel()
    size = np.bincount(stretch)
    p = p - np.stack([np.bincount(stretch, p[:, k]) / size for k in range(3)], axis=1)[stretch]
    n, K = len(z), len(size)
    offsets = np.zeros((n, K))
    offsets[np.arange(n), stretch] = 1.0
    J = np.column_stack([p[:, 2], p[:, 1], -p[:, 0], np.zeros(n), offsets])[None]  # (delta x p)_z = dx y - dy x
    together = stretch[:, None] == stretch[None]
    memory = np.exp(-np.abs(t[:, None] - t[None]) / MAP_DRIFT_MEMORY_S) * together
    wandering = 0.0 * memory
    if aged is not None:
        risen = np.tril(together) * np.diff(p[:, 2], prepend=p[0, 2])[None]  # sums of these are heights up to offsets
        wandering = (wander * scale) ** 2 * (risen @ _common(np.interp(t, stamp_s, aged)) @ risen.T)
    wandering = wandering + MAP_PIVOT_M**2 * (down @ down.T)
    prior = _tilt_prior(scale, tilt_sigma_rad, K)
    weight: FloatArray = np.ones(n)
    fit: _Fit | None = None
    drift = MAP_DRIFT_M[0]
    for k in range(4):
        white = (sigma_m**2 + (scale * sigma_map) ** 2) / count / np.maximum(weight, _LEAST_WEIGHT)
        likeliest = -math.inf
        for a in MAP_DRIFT_M if k == _SELECTED_AT else [drift]:
            found = _fitted(white, a**2 * memory + wandering, J, J, z[None, :, None], prior)
            if found is not None and found.log_likelihood > likeliest:
                fit, drift, likeliest = found, a, found.log_likelihood
        if fit is None:
            return None
        clean = fit.residual[0] - fit.slow[0]
        normalised = np.abs(clean) / np.sqrt((sigma_m**2 + (scale * sigma_map) ** 2) / count)
        spread = max(robust_sigma(normalised), 0.3)
        weight = tukey_weight(normalised, spread)
    if fit is None:
        return None
    A, v = fit.information.copy(), fit.vector
    noise_log = fit.slow_trace / max(scale**2 * float(A[_SCALE, _SCALE]), 1e-30)
    A[_SCALE, _SCALE] -= fit.inverse_trace * sigma_map**2 / float(np.mean(count))  # bias from noise in the regressor
    if not A[_SCALE, _SCALE] > 0:
        return None
    inner = np.linalg.inv(A[_OFFSETS, _OFFSETS] + 1e-9 * np.eye(K))  # the offsets are marginalised
    information = A[_THETA, _THETA] - A[_THETA, _OFFSETS] @ inner @ A[_OFFSETS, _THETA]
    vector = v[_THETA] - A[_THETA, _OFFSETS] @ inner @ v[_OFFSETS]
    rms = math.sqrt(float(np.sum(weight * clean**2)) / max(float(weight.sum()), 1e-9))
    return Evidence(0.5 * (information + information.T), vector, rms, noise_log=noise_log)


def _unrest(covariance: FloatArray, fit: "_Fit", J: FloatArray, latent: FloatArray, target: FloatArray) -> float:
    """Error of the mean scale [m per map unit] due to differences between parts of the flight beyond their noise.

    Scale drift of the map, or telemetry that is right only in part, does not show in the residuals within a part.
    Outliers of the fit are included: they may be a part of the map with another scale. The variance between parts is
    that of a random-effects model (DerSimonian and Laird 1986).
    """
    n = len(covariance)
    parts = min(_MOST_PARTS, n // MIN_DISPLACEMENTS)
    if parts < 2:
        return 0.0
    scale, information = np.zeros(parts), np.zeros(parts)
    for k, i in enumerate(np.array_split(np.arange(n), parts)):
        inverse = np.linalg.inv(covariance[np.ix_(i, i)])
        A = np.einsum("anu,anv->uv", latent[:, i], inverse @ J[:, i])[_SCALE]
        v = float(np.einsum("an,anx->", latent[:, i, _SCALE], inverse @ target[:, i]))
        information[k] = max(float(A[_SCALE]), 0.0)
        scale[k] = (v - float(A[1:] @ fit.theta[1:])) / max(float(A[_SCALE]), 1e-30)
    information /= fit.kappa
    total, squares = float(information.sum()), float(np.sum(information**2))
    room = total - squares / max(total, 1e-30)
    if not room > 0:
        return 0.0
    scatter = float(np.sum(information * (scale - np.sum(information * scale) / total) ** 2))
    between = max(0.0, (scatter - (parts - 1)) / room)
    return math.sqrt(between * squares) / total


def aged_since(stamps_s: FloatArray, began_s: float, now_s: float) -> FloatArray:
    """Log of the map's age now over its age at each stamp ``(N,)``; a map drifts most in its first seconds."""
    return np.asarray(np.log((now_s - began_s + _LEAST_AGE_S) / (np.maximum(stamps_s - began_s, 0.0) + _LEAST_AGE_S)))


def turned_since(T: FloatArray) -> FloatArray:
    """Maximum rotation ``(N,)`` since each pose ``T`` ``(N, 4, 4)`` relative to the last one, in fields of view beyond
    the first, within which views overlap."""
    cosine = 0.5 * (np.einsum("nij,ij->n", T[:, :3, :3], T[-1, :3, :3]) - 1.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.maximum(np.maximum.accumulate(angle[::-1])[::-1] / _VIEW_RAD - 1.0, 0.0)


def _common(aged: FloatArray) -> FloatArray:
    """Covariance ``(N, N)`` of the scale changes since two moments: a random walk back from the present."""
    return np.minimum(aged[:, None], aged[None])


def _of_changes(lag_s: FloatArray, duration_s: FloatArray, memory_s: float) -> FloatArray:
    """Correlation of an Ornstein-Uhlenbeck process's changes over intervals ``(N, N)``."""

    def at(gap_s: FloatArray) -> FloatArray:
        return np.asarray(np.exp(-np.abs(gap_s) / memory_s))

    mine, other = duration_s[:, None], duration_s[None]
    return at(lag_s + mine - other) + at(lag_s) - at(lag_s + mine) - at(lag_s - other)


@dataclass(frozen=True, slots=True)
class _Fit:
    theta: FloatArray
    information: FloatArray
    vector: FloatArray
    residual: FloatArray
    whitened: FloatArray
    """``(axes, N)``, the residual times the inverse covariance."""
    slow: FloatArray
    """``(axes, N)``, the part of the residual due to correlated noise."""
    inverse_trace: float
    slow_trace: float
    """Of the inverse covariance times the covariance of correlated noise."""
    kappa: float
    """Variance of the residuals over the expected one."""
    log_likelihood: float


def _fitted(
    white: FloatArray, slow: FloatArray, J: FloatArray, latent: FloatArray, target: FloatArray, prior: FloatArray
) -> _Fit | None:
    """Generalised least squares ``(axes, N, unknowns)`` with independent ``(N,)`` and correlated noise ``(N, N)``."""
    n = len(white)
    C = slow.copy()
    C.flat[:: n + 1] += white
    sign, spent = np.linalg.slogdet(C)
    if sign <= 0:
        return None
    inverse = np.linalg.inv(C)
    A = np.einsum("anu,anv->uv", latent, inverse @ J)  # J is (axes, N, unknowns)
    A = 0.5 * (A + A.T)
    v = np.einsum("anu,anx->u", latent, inverse @ target)
    try:
        theta = np.linalg.solve(A + prior, v)
    except np.linalg.LinAlgError:
        return None
    residual = (target[:, :, 0] - J @ theta).reshape(len(J), n)
    whitened = residual @ inverse
    dof = residual.size + _BELIEF
    kappa = (float(np.sum(residual * whitened)) + _BELIEF) / dof
    sign, logdet = np.linalg.slogdet(A + prior)
    spent = len(J) * float(spent) + (float(logdet) if sign > 0 else math.inf)
    likely = -0.5 * (dof * math.log(kappa) + spent)
    trace, slow_trace = float(np.trace(inverse)) / kappa, float(np.sum(inverse * slow)) / kappa
    return _Fit(theta, A / kappa, v / kappa, residual, whitened, whitened @ slow, trace, slow_trace, kappa, likely)
