r"""What telemetry says of a camera's positions at some moments, as a Gaussian with everything unknown marginalised.

All measurements are linear in the positions :math:`p_k` (world axes, map units):

.. math::
    s\,(p_{k+1} - p_k) = d_k + \epsilon_k, \qquad s\,z_k + c = h_k + \eta_k

with displacements :math:`d` from integrated velocities and heights :math:`h` above a floor whose level :math:`c`
changes where furniture passes below. The errors are added up from what they are: noise of single readings; the interval
of the rounding, whose error stays in part as long as its reading and else for a second; a velocity bias that decays in
seconds; and, common to all, the scale, the map's tilt, the video's delay and whether the drone rounds or truncates.
These nuisance parameters are columns of the covariance, so that the solver does not see them. The scale's column is the
map's own way :math:`s\,p`: with :math:`d` in its place, a map that disagrees would cost less the smaller it is.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from edgeslam_torch.fusion.config import FusionConfig
from edgeslam_torch.fusion.scale.log_scale import floor_segments
from edgeslam_torch.fusion.telemetry.track import TelemetryTrack
from edgeslam_torch.geometry.robust_statistics import tukey_weight
from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.types import FloatArray, IntArray

BIAS_M_S = 0.015
"""Standard deviation of the velocity bias: the middle of what flights show (`joint_scale`)."""
BIAS_MEMORY_S = 12.0
_LASTING, _VARIES_S = 0.25, 1.0
"""Share of a rounding error's variance that lasts as long as its reading, and time in which the rest changes [s]. In
flights at speeds that vary by a step in two seconds the mean over a reading's three seconds and more is .01 m/s off;
an error that lasted would be .029."""
SENSOR_M_S = 0.02
"""Noise of one velocity reading before it is rounded."""
HEIGHT_MEMORY_S = 3.0
"""How long an error of SDK height or barometer lasts."""
TILT_RAD = math.radians(2.0)
"""Error of the rotation from map to world: of the camera's mount, above all."""
LONGEST_S = 10.0
"""Time between two positions beyond which integrated velocity says too little of them."""
DELAY_S = 0.3
"""Standard deviation of a delay that nothing has told yet [s]."""
FLOOR_M = 30.0
"""Prior on the floor's level: none."""
UP_RAD = math.radians(2.0)
"""Error of the direction of gravity in one picture: mount, accelerations in flight."""
UP_MEMORY_S = 5.0
_UNPROVEN_S = 3.0
"""How far off the stamps of telemetry may be that has not yet turned with the images: `comparison` looks so far."""
_STEADY_RAD = math.radians(15.0)
"""Lean of a drone that takes off and flies slowly, at most; a camera in a hand rolls by more, and its attitude may be
another moment's until it has proven otherwise."""
_STILL_M_S = 0.05
"""Speed along an axis up to which a drone stands, whatever a map unit is: half a step of the SDK."""
_LEAST_WEIGHT = 1e-4
_BENT = 0.2
"""Share of a way by which the map may be off without the reading being a wild one: that is what is to be mended."""


@dataclass(frozen=True, slots=True)
class PositionGaussian:
    """``chi2 = p^T A p - 2 b^T p + c`` of camera positions ``p``, stacked as ``(3 K,)`` [map units, map axes]."""

    information: FloatArray
    """``(3 K, 3 K)``; the common position is not determined."""
    vector: FloatArray
    """``(3 K,)``"""
    constant: float
    rows: int
    """Measurements."""
    refused: int
    """Of them, wild ones: beyond their sigmas and beyond what a bent map could explain."""


@dataclass(frozen=True, slots=True)
class UpDirections:
    """Gravity in some pictures."""

    frame: IntArray
    """``(U,)`` which of the frames asked about."""
    up_c: FloatArray
    """``(U, 3)`` unit vectors, camera axes."""
    up_m: FloatArray
    """``(3,)`` the same in the map."""
    sigma_rad: float
    """Of each, per axis."""


@dataclass(frozen=True, slots=True)
class _Rows:
    """Linear measurements of positions in world axes [m]: ``D p`` should be ``told``."""

    D: FloatArray
    """``(M, K, 3)`` without the scale."""
    told: FloatArray
    """``(M,)``"""
    white: FloatArray
    """``(M,)`` variances of what is independent."""
    slow: FloatArray
    """``(M, M)`` covariance of what has a memory."""
    common: FloatArray
    """``(M, C)`` change of ``told`` per standard deviation of each common nuisance parameter."""
    group: IntArray
    """``(M,)`` rows that are one measurement."""
    way: FloatArray
    """``(M,)`` length of what each row is about [m]."""


@dataclass(frozen=True, slots=True)
class TelemetryModel:
    """Telemetry as it is at one moment, and what ties it to the map."""

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
    """Infinite where only gravity is known."""
    velocity: bool
    """Whether velocities may speak."""
    height: str | None
    """Name of the height that may speak, if any."""
    truncates: float
    """Probability that velocities are truncated, not rounded."""
    attitude: bool = True
    """Whether attitude may speak."""
    young: bool = False
    """Whether the map has begun seconds ago."""
    standing: bool = False
    """Whether, where velocities may not speak, those of a drone that stands may: nothing is nothing in any unit."""

    @property
    def knows_metres(self) -> bool:
        """Whether more than gravity is known."""
        return math.isfinite(self.scale_sigma_log)

    @property
    def holds_level(self) -> bool:
        """Whether attitude decides what turned and what moved: the map's depths are guesses still."""
        return self.young and not self.knows_metres

    def positions(
        self, stamps_s: FloatArray, p_m: FloatArray, scale_sigma_log: float | None = None
    ) -> PositionGaussian | None:
        """What telemetry says of camera positions.

        Args:
            stamps_s: Increasing stamps of frames ``(K,)``.
            p_m: Positions in the map as it is ``(K, 3)`` [map units]: what single measurements are compared with, to
                refuse those that disagree with the rest.
            scale_sigma_log: Standard deviation of the scale's logarithm; the estimate's own when None.

        Returns:
            The Gaussian, or None where telemetry is silent.
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
        """Gravity in frames at ``stamps_s`` ``(K,)``; None where no attitude is told."""
        if len(self.track) < 2 or not (self.attitude and self.track.has_attitude):
            return None
        at_s = stamps_s - self.delay_s
        use = self.track.covered(at_s, at_s)
        if not self.knows_metres:  # half a degree of lean is motion to a map without parallax, and its depths run away
            use &= is_steady(self.track, at_s)
        frame = np.flatnonzero(use)
        if len(frame) == 0:
            return None
        t = at_s[frame]
        R_w_c = self.track.attitude(t) @ self.T_b_c[:3, :3]
        # Neighbours err alike: together they count as one.
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
        told = self.track.readings
        share = _shares(told.stamp_s, start, end)  # (N, S)
        heard = np.flatnonzero(share.any(axis=0))
        share = share[:, heard]
        R_w = self.track.axes()[heard]
        raw = np.einsum("swa,sw->sa", R_w, told.velocity[heard])
        U = _runs(share, told.stamp_s[heard], raw, R_w, step, truncates)
        bias = BIAS_M_S**2 * np.exp(-np.abs(start[:, None] - start[None]) / BIAS_MEMORY_S) * np.outer(L, L)
        slow = U @ U.T + np.einsum("ij,ab->iajb", bias, np.eye(3)).reshape(3 * N, 3 * N)
        half = 0.5 * step * math.sqrt(truncates * (1.0 - truncates))
        speed = self.track.displacement(at_s + 0.05) - self.track.displacement(at_s - 0.05)
        delay = min(self.delay_sigma_s, DELAY_S)
        common = np.concatenate(
            [
                np.diff(per_scale_w, axis=0)[use][..., None],
                TILT_RAD * hat(d),
                (delay * 10.0 * np.diff(speed, axis=0)[use])[..., None],
                (half * np.einsum("ns,sa->na", share, told.sign[heard]))[..., None],
            ],
            axis=-1,
        )
        white = np.repeat(SENSOR_M_S**2 * 0.1 * L, 3)
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
        """Rows of the height that may speak; ``per_scale_w`` as in `_displacements`."""
        name = self.height
        stamp, z = self.track.heights().get(name or "", (np.zeros(0), np.zeros(0)))
        if len(stamp) < 2:
            return None
        sigma = float(getattr(self.config, f"sigma_{name}_m"))
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
        rounded = name == "tof"  # centimetres; the others move in steps or wander
        white = np.full(M, sigma**2 if rounded else 0.25 * sigma**2)
        slow = (0.1 if rounded else 1.0) * lasting + level
        return _Rows(D, h, white, slow, common, np.arange(M), np.abs(rise))

    def _gaussian(self, rows: _Rows, p_m: FloatArray) -> PositionGaussian:
        """Marginalise, weigh out what disagrees with the rest, and turn to map axes."""
        D = np.einsum("mkw,wv->mkv", rows.D, self.R_w_m).reshape(len(rows.told), -1) * self.scale
        residual = D @ p_m.ravel() - rows.told
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
        whitened = cho_solve(factor, np.column_stack([D, rows.told]))
        A = D.T @ whitened[:, :-1]
        refused = int(np.count_nonzero(tukey <= _LEAST_WEIGHT))
        return PositionGaussian(
            0.5 * (A + A.T), D.T @ whitened[:, -1], float(rows.told @ whitened[:, -1]), len(tukey), refused
        )


def is_steady(track: TelemetryTrack, at_s: FloatArray) -> NDArray[np.bool_]:
    """Whether a drone leans at moments ``(N,)`` as one that takes off does, whichever moment near by is meant."""
    return np.asarray(track.leaned(at_s, _UNPROVEN_S) < _STEADY_RAD)


def _still(rows: _Rows | None, at_s: FloatArray) -> _Rows | None:
    """Of displacements between moments ``(K,)`` those along axes along which the drone stands."""
    if rows is None:
        return None
    lasted_s = rows.D.sum(2) @ at_s
    keep = np.flatnonzero(np.abs(rows.told) < _STILL_M_S * lasted_s)
    if len(keep) == 0:
        return None
    group = np.unique(rows.group[keep], return_inverse=True)[1]
    return _Rows(
        rows.D[keep],
        rows.told[keep],
        rows.white[keep],
        rows.slow[np.ix_(keep, keep)],
        rows.common[keep],
        group,
        rows.way[keep],
    )


def _stacked(parts: list[_Rows]) -> _Rows | None:
    if not parts:
        return None
    size = sum(len(part.told) for part in parts)
    slow, at, groups = np.zeros((size, size)), 0, 0
    group = []
    for part in parts:
        n = len(part.told)
        slow[at : at + n, at : at + n] = part.slow
        group.append(part.group + groups)
        at, groups = at + n, groups + int(part.group[-1]) + 1
    return _Rows(
        np.concatenate([p.D for p in parts]),
        np.concatenate([p.told for p in parts]),
        np.concatenate([p.white for p in parts]),
        slow,
        np.concatenate([p.common for p in parts]),
        np.concatenate(group),
        np.concatenate([p.way for p in parts]),
    )


def _shares(stamp_s: FloatArray, start_s: FloatArray, end_s: FloatArray) -> FloatArray:
    """Time [s] for which each reading stands in each interval ``(N, S)``: from half-way to its neighbours."""
    middle = 0.5 * (stamp_s[1:] + stamp_s[:-1])
    low, high = np.append(-np.inf, middle), np.append(middle, np.inf)
    overlap = np.minimum(end_s[:, None], high) - np.maximum(start_s[:, None], low)
    return np.maximum(overlap, 0.0)


def _runs(
    share: FloatArray, stamp_s: FloatArray, velocity: FloatArray, R_w: FloatArray, step_m_s: float, truncates: float
) -> FloatArray:
    """Errors of displacements per standard deviation of each rounding error ``(3 N, runs)``.

    A rounding error is uniform within the step, or, for a zero that may be a truncated one, within two steps. While a
    reading stays the same a part of its error does, too, as at an even speed; the rest changes with the speed.

    Args:
        share: From `_shares` ``(N, S)``.
        stamp_s: Of the readings ``(S,)``.
        velocity: Readings in the drone's own axes ``(S, 3)``.
        R_w: Those axes to world ``(S, 3, 3)``.
        step_m_s: The step.
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
