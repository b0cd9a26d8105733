r"""Camera positions by telemetry as a Gaussian with nuisance parameters marginalised.

All measurements are linear in the positions :math:`p_k` (world axes, map units):

.. math::
    s\,(p_{k+1} - p_k) = d_k + \epsilon_k, \qquad s\,z_k + c = h_k + \eta_k

with displacements :math:`d` from integrated velocities and heights :math:`h` above a floor whose level :math:`c`
changes where furniture passes below. The error model: noise of single readings; quantisation, partly constant within
equal readings and partly decorrelating in a second; a velocity bias that decays in seconds; and the common nuisance
parameters scale, tilt of the map, video delay, and rounding or truncation. The nuisance parameters are columns of the
covariance, so that the solver does not need them. The scale's column is the map's own path :math:`s\,p`: with :math:`d`
instead, a contradictory map would cost less the smaller it is.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.scale.log_scale import floor_segments
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.geometry.robust_statistics import tukey_weight
from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.noise import (
    DELAY_S,
    HEIGHT_M,
    HEIGHT_MEMORY_S,
    TILT_RAD,
    UP_MEMORY_S,
    UP_RAD,
    VELOCITY_BIAS_M_S,
    VELOCITY_BIAS_MEMORY_S,
    VELOCITY_SENSOR_M_S,
)
from edgeslam_torch.types import FloatArray, IntArray

_LASTING, _VARIES_S = 0.25, 1.0
"""Share of a quantisation error's variance that is constant while the reading is, and correlation time of the rest [s].
Over a reading of three seconds the mean error is .01 m/s at varying speed; for a constant speed it would be .029."""
LONGEST_S = 10.0
"""Maximum time between two positions for integrated velocity."""
FLOOR_M = 30.0
"""Uninformative prior on the floor's level."""
_UNPROVEN_S = 3.0
"""Range of delays to consider before telemetry is validated, as in `comparison`."""
_STEADY_RAD = math.radians(15.0)
"""Maximum lean of a drone that takes off and flies slowly. A hand-held camera rolls by more, and its unvalidated
attitude may have the wrong stamp."""
_STILL_M_S = 0.05
"""Speed along an axis below which the drone is at rest: half a step of the SDK; independent of the map's scale."""
_LEAST_WEIGHT = 1e-4
_BENT = 0.2
"""Share of a path by which the map may be distorted before a reading counts as an outlier: the reading should correct
it."""


@dataclass(frozen=True, slots=True)
class PositionGaussian:
    """``chi2 = p^T A p - 2 b^T p + c`` of camera positions ``p``, stacked as ``(3 K,)`` [map units, map axes]."""

    information: FloatArray
    """``(3 K, 3 K)``; the common position is not determined."""
    vector: FloatArray
    """``(3 K,)``"""
    constant: float
    rows: int
    """Number of measurements."""
    refused: int
    """Number of outliers: beyond their sigmas and beyond what a distorted map could explain."""


@dataclass(frozen=True, slots=True)
class UpDirections:
    """Direction of gravity in some frames."""

    frame: IntArray
    """``(U,)`` indices of the frames."""
    up_c: FloatArray
    """``(U, 3)`` unit vectors, camera axes."""
    up_m: FloatArray
    """``(3,)`` the same in map axes."""
    sigma_rad: float
    """Standard deviation per axis of each."""


@dataclass(frozen=True, slots=True)
class _Rows:
    """Linear measurements of positions in world axes [m]: ``D p = measured``."""

    D: FloatArray
    """``(M, K, 3)`` without the scale."""
    measured: FloatArray
    """``(M,)``"""
    white: FloatArray
    """``(M,)`` variances of independent errors."""
    slow: FloatArray
    """``(M, M)`` covariance of correlated errors."""
    common: FloatArray
    """``(M, C)`` change of ``measured`` per standard deviation of each common nuisance parameter."""
    group: IntArray
    """``(M,)`` groups of rows that form one measurement."""
    way: FloatArray
    """``(M,)`` path length of each row [m]."""


@dataclass(frozen=True, slots=True)
class TelemetryModel:
    """Telemetry at one time, and its alignment with the map."""

    track: TelemetryTrack
    config: FusionConfig
    T_b_c: FloatArray
    R_w_m: FloatArray
    """``(3, 3)`` map to power-on world."""
    delay_s: float
    delay_sigma_s: float
    scale: float
    """Metres per map unit."""
    scale_sigma_log: float
    """Infinite if only gravity is available."""
    velocity: bool
    """Whether velocities are usable."""
    height: str | None
    """Name of the height in use, if any."""
    truncates: float
    """Probability that velocities are truncated, not rounded."""
    attitude: bool = True
    """Whether attitude is usable."""
    young: bool = False
    """Whether the map is only seconds old."""
    standing: bool = False
    """Whether zero readings are usable although velocities are not: zero is independent of the scale."""

    @property
    def knows_metres(self) -> bool:
        """Whether the metric scale is known."""
        return math.isfinite(self.scale_sigma_log)

    @property
    def holds_level(self) -> bool:
        """Whether attitude constrains the frames: the map still rests on predicted depths."""
        return self.young and not self.knows_metres

    def positions(
        self, stamps_s: FloatArray, p_m: FloatArray, scale_sigma_log: float | None = None
    ) -> PositionGaussian | None:
        """Camera positions by telemetry.

        Args:
            stamps_s: Increasing stamps of frames ``(K,)``.
            p_m: Positions in the present map ``(K, 3)`` [map units], for rejecting single measurements that disagree
                with the rest.
            scale_sigma_log: Standard deviation of the scale's logarithm; the estimate's own if None.

        Returns:
            The Gaussian, or None without telemetry.
        """
        if len(stamps_s) < 2 or len(self.track) < 2 or not (self.velocity or self.standing or self.height is not None):
            return None
        sigma = self.scale_sigma_log if scale_sigma_log is None else scale_sigma_log
        at_s = stamps_s - self.delay_s
        per_scale_w = sigma * self.scale * p_m @ self.R_w_m.T
        parts = []
        if self.velocity:
            parts.append(self._displacements(at_s, per_scale_w))
        elif self.standing:
            parts.append(_still(self._displacements(at_s, np.zeros_like(per_scale_w)), at_s))
        if self.height is not None:
            parts.append(self._heights(at_s, per_scale_w))
        rows = _stacked([part for part in parts if part is not None])
        return None if rows is None else self._gaussian(rows, p_m)

    def up(self, stamps_s: FloatArray) -> UpDirections | None:
        """Gravity in frames at ``stamps_s`` ``(K,)``; None without attitude."""
        if len(self.track) < 2 or not (self.attitude and self.track.has_attitude):
            return None
        at_s = stamps_s - self.delay_s
        use = self.track.covered(at_s, at_s)
        if not self.knows_metres:  # without parallax half a degree of lean looks like motion, and depths diverge
            use &= is_steady(self.track, at_s)
        frame = np.flatnonzero(use)
        if len(frame) == 0:
            return None
        t = at_s[frame]
        R_w_c = self.track.attitude(t) @ self.T_b_c[:3, :3]
        # Errors of neighbours are correlated: together they count as one.
        alike = (np.abs(t[:, None] - t[None]) < 0.5 * UP_MEMORY_S).sum(1)
        return UpDirections(frame, R_w_c[:, 2, :], self.R_w_m[2], UP_RAD * math.sqrt(float(np.median(alike))))

    def _displacements(self, at_s: FloatArray, per_scale_w: FloatArray) -> _Rows | None:
        """Rows of the velocities; ``per_scale_w`` ``(K, 3)``: change of the positions per sigma of the scale [m]."""
        start, end = at_s[:-1], at_s[1:]
        use = np.flatnonzero(self.track.covered(start, end) & (end - start < LONGEST_S))
        if len(use) == 0:
            return None
        step = self.config.velocity_step_m_s
        truncates = self.truncates
        moved = np.diff(self.track.displacement(at_s, truncates * 0.5 * step), axis=0)[use]
        lever = self.track.attitude(at_s) @ self.T_b_c[:3, 3]
        d = moved + np.diff(lever, axis=0)[use]
        start, end, L = start[use], end[use], (end - start)[use]
        N, K = len(use), len(at_s)
        D = np.zeros((N, 3, K, 3))
        for axis in range(3):
            D[np.arange(N), axis, use + 1, axis] = 1.0
            D[np.arange(N), axis, use, axis] = -1.0
        measured = self.track.readings
        share = _shares(measured.stamp_s, start, end)  # (N, S)
        heard = np.flatnonzero(share.any(axis=0))
        share = share[:, heard]
        R_w = self.track.axes()[heard]
        raw = np.einsum("swa,sw->sa", R_w, measured.velocity[heard])
        U = _runs(share, measured.stamp_s[heard], raw, R_w, step, truncates)
        memory = np.exp(-np.abs(start[:, None] - start[None]) / VELOCITY_BIAS_MEMORY_S)
        bias = VELOCITY_BIAS_M_S**2 * memory * np.outer(L, L)
        slow = U @ U.T + np.einsum("ij,ab->iajb", bias, np.eye(3)).reshape(3 * N, 3 * N)
        half = 0.5 * step * math.sqrt(truncates * (1.0 - truncates))
        speed = self.track.displacement(at_s + 0.05) - self.track.displacement(at_s - 0.05)
        delay = min(self.delay_sigma_s, DELAY_S)
        common = np.concatenate(
            [
                np.diff(per_scale_w, axis=0)[use][..., None],
                TILT_RAD * hat(d),
                (delay * 10.0 * np.diff(speed, axis=0)[use])[..., None],
                (half * np.einsum("ns,sa->na", share, measured.sign[heard]))[..., None],
            ],
            axis=-1,
        )
        white = np.repeat(VELOCITY_SENSOR_M_S**2 * 0.1 * L, 3)
        group = np.repeat(np.arange(N), 3)
        return _Rows(
            D.reshape(3 * N, K, 3),
            d.ravel(),
            white,
            slow,
            common.reshape(3 * N, -1),
            group,
            np.repeat(np.linalg.norm(d, axis=1), 3),
        )

    def _heights(self, at_s: FloatArray, per_scale_w: FloatArray) -> _Rows | None:
        """Rows of the height in use; ``per_scale_w`` as in `_displacements`."""
        name = self.height
        stamp, z = self.track.heights().get(name or "", (np.zeros(0), np.zeros(0)))
        if len(stamp) < 2:
            return None
        sigma = HEIGHT_M[name]
        own = self.track.displacement(stamp)[:, 2]
        segment = floor_segments(stamp, z, own, step_m=max(0.08, 4.0 * sigma))
        after = np.clip(np.searchsorted(stamp, at_s), 1, len(stamp) - 1)
        near = (at_s >= stamp[after - 1]) & (at_s <= stamp[after]) & (stamp[after] - stamp[after - 1] < 0.35)
        use = np.flatnonzero(near & (segment[after] == segment[after - 1]))
        part = segment[after[use]]
        use = use[np.bincount(part)[part] > 1] if len(use) else use
        if len(use) < 2:
            return None
        part = np.unique(segment[after[use]], return_inverse=True)[1]
        R = self.track.attitude(at_s[use])
        h = np.interp(at_s[use], stamp, z) + R[:, 2, :] @ self.T_b_c[:3, 3]
        M, K = len(use), len(at_s)
        D = np.zeros((M, K, 3))
        D[np.arange(M), use, 2] = 1.0
        same = part[:, None] == part[None]
        t = at_s[use]
        lasting = sigma**2 * np.exp(-np.abs(t[:, None] - t[None]) / HEIGHT_MEMORY_S)
        level = FLOOR_M**2 * same
        rise = h - (same @ h) / same.sum(1)
        way = self.track.displacement(t)
        way = way - (same @ way) / same.sum(1)[:, None]
        fast = (np.interp(t + 0.1, stamp, own) - np.interp(t - 0.1, stamp, own)) / 0.2
        none = np.zeros(M)
        tilt = TILT_RAD * np.stack([-way[:, 1], way[:, 0], none], axis=1)  # the last row of hat(way)
        delay = min(self.delay_sigma_s, DELAY_S)
        per_scale = per_scale_w[use, 2]
        per_scale = per_scale - (same @ per_scale) / same.sum(1)
        common = np.column_stack([per_scale, tilt, delay * fast, none])
        rounded = name == "tof"  # quantised to centimetres; the others move in steps or drift
        white = np.full(M, sigma**2 if rounded else 0.25 * sigma**2)
        slow = (0.1 if rounded else 1.0) * lasting + level
        return _Rows(D, h, white, slow, common, np.arange(M), np.abs(rise))

    def _gaussian(self, rows: _Rows, p_m: FloatArray) -> PositionGaussian:
        """Marginalise, reweight outliers, and rotate to map axes."""
        D = np.einsum("mkw,wv->mkv", rows.D, self.R_w_m).reshape(len(rows.measured), -1) * self.scale
        residual = D @ p_m.ravel() - rows.measured
        slow = rows.slow + rows.common @ rows.common.T
        weight = np.ones(len(residual))
        for _ in range(3):
            factor = cho_factor(slow + np.diag(rows.white / weight), lower=True)
            clean = residual - slow @ cho_solve(factor, residual)
            allowed = rows.white + np.square(_BENT * np.minimum(rows.way, np.median(rows.way)))
            power = np.bincount(rows.group, clean**2 / allowed)
            z = np.sqrt(power)
            spread = max(1.0, float(np.median(z)))
            tukey = tukey_weight(z, spread)
            weight = np.maximum(tukey, _LEAST_WEIGHT)[rows.group]
        factor = cho_factor(slow + np.diag(rows.white / weight), lower=True)
        whitened = cho_solve(factor, np.column_stack([D, rows.measured]))
        A = D.T @ whitened[:, :-1]
        refused = int(np.count_nonzero(tukey <= _LEAST_WEIGHT))
        return PositionGaussian(
            0.5 * (A + A.T), D.T @ whitened[:, -1], float(rows.measured @ whitened[:, -1]), len(tukey), refused
        )


def is_steady(track: TelemetryTrack, at_s: FloatArray) -> NDArray[np.bool_]:
    """Whether the drone leans no more than in take-off around times ``(N,)``, for any plausible delay."""
    return np.asarray(track.leaned(at_s, _UNPROVEN_S) < _STEADY_RAD)


def _still(rows: _Rows | None, at_s: FloatArray) -> _Rows | None:
    """Displacements between times ``(K,)`` along axes at rest."""
    if rows is None:
        return None
    lasted_s = rows.D.sum(2) @ at_s
    keep = np.flatnonzero(np.abs(rows.measured) < _STILL_M_S * lasted_s)
    if len(keep) == 0:
        return None
    group = np.unique(rows.group[keep], return_inverse=True)[1]
    return _Rows(
        rows.D[keep],
        rows.measured[keep],
        rows.white[keep],
        rows.slow[np.ix_(keep, keep)],
        rows.common[keep],
        group,
        rows.way[keep],
    )


def _stacked(parts: list[_Rows]) -> _Rows | None:
    if not parts:
        return None
    size = sum(len(part.measured) for part in parts)
    slow, at, groups = np.zeros((size, size)), 0, 0
    group = []
    for part in parts:
        n = len(part.measured)
        slow[at : at + n, at : at + n] = part.slow
        group.append(part.group + groups)
        at, groups = at + n, groups + int(part.group[-1]) + 1
    return _Rows(
        np.concatenate([p.D for p in parts]),
        np.concatenate([p.measured for p in parts]),
        np.concatenate([p.white for p in parts]),
        slow,
        np.concatenate([p.common for p in parts]),
        np.concatenate(group),
        np.concatenate([p.way for p in parts]),
    )


def _shares(stamp_s: FloatArray, start_s: FloatArray, end_s: FloatArray) -> FloatArray:
    """Time [s] for which each reading is valid in each interval ``(N, S)``: to the midpoints with its neighbours."""
    middle = 0.5 * (stamp_s[1:] + stamp_s[:-1])
    low, high = np.append(-np.inf, middle), np.append(middle, np.inf)
    overlap = np.minimum(end_s[:, None], high) - np.maximum(start_s[:, None], low)
    return np.maximum(overlap, 0.0)


def _runs(
    share: FloatArray, stamp_s: FloatArray, velocity: FloatArray, R_w: FloatArray, step_m_s: float, truncates: float
) -> FloatArray:
    """Errors of displacements per standard deviation of each quantisation error ``(3 N, runs)``.

    A quantisation error is uniform within a step, or within two steps for a zero that may be truncated. While a reading
    stays constant, part of its error does as well; the rest changes with the speed.

    Args:
        share: From `_shares` ``(N, S)``.
        stamp_s: Stamps of the readings ``(S,)``.
        velocity: Readings in the drone's own axes ``(S, 3)``.
        R_w: Those axes to world ``(S, 3, 3)``.
        step_m_s: Quantisation step.
        truncates: Probability of truncation.
    """
    N = len(share)
    columns = []
    for axis in range(3):
        v = velocity[:, axis]
        changes = np.append(True, np.abs(np.diff(v)) > 1e-6)
        first_s = stamp_s[changes][np.cumsum(changes) - 1]
        later = np.floor((stamp_s - first_s) / _VARIES_S)
        for begin, part in ((changes, _LASTING), (changes | np.append(True, np.diff(later) > 0), 1.0 - _LASTING)):
            at = np.flatnonzero(begin)
            zero = np.abs(v[at]) < 1e-6
            sigma = step_m_s * np.sqrt(part / 12.0 * np.where(zero, 1.0 + 3.0 * truncates, 1.0))
            turned = np.stack([np.add.reduceat(share * R_w[:, w, axis], at, axis=1) for w in range(3)], axis=1)
            columns.append((turned * sigma).reshape(3 * N, -1))
    return np.concatenate(columns, axis=1)
