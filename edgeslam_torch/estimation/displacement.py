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

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.sensors.attitude import Headings, UpDirections, headings, up_directions
from edgeslam_torch.estimation.sensors.height import heights
from edgeslam_torch.estimation.sensors.rows import Rows, stacked
from edgeslam_torch.estimation.sensors.velocity import displacements
from edgeslam_torch.estimation.telemetry.track import TelemetryTrack
from edgeslam_torch.gate import consistent
from edgeslam_torch.geometry.robust_statistics import tukey_weight
from edgeslam_torch.noise import ATTITUDE_RAD, CONTRADICTS, MOUNT_RAD
from edgeslam_torch.types import FloatArray

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
    new_map: bool = False
    """Whether the map is only seconds old."""
    mount_sigma_rad: float = MOUNT_RAD
    """Standard deviation per axis of the camera's mount."""
    turns: bool = True
    """Whether the images have validated attitude."""
    gain_sigma: tuple[float, ...] = (0.0, 0.0, 0.0)
    """Relative standard deviation of each velocity column, beyond that of the scale."""

    @property
    def metric(self) -> bool:
        """Whether the metric scale is known."""
        return math.isfinite(self.scale_sigma_log)

    @property
    def holds_level(self) -> bool:
        """Whether attitude constrains the frames: the map still rests on predicted depths."""
        return self.new_map and not self.metric

    def positions(
        self,
        stamps_s: FloatArray,
        p_m: FloatArray,
        scale_sigma_log: float | None = None,
        guessed: NDArray[np.bool_] | None = None,
    ) -> PositionGaussian | None:
        """Camera positions by telemetry.

        Args:
            stamps_s: Increasing stamps of frames ``(K,)``.
            p_m: Positions in the present map ``(K, 3)`` [map units], for rejecting single measurements that disagree
                with the rest.
            scale_sigma_log: Standard deviation of the scale's logarithm; the estimate's own if None.
            guessed: Frames ``(K,)`` on predicted depths, or whose tilt attitude contradicts: there the map may be wrong
                by the whole way, and no reading is an outlier beside it. None if None.

        Returns:
            The Gaussian, or None without telemetry.
        """
        if len(stamps_s) < 2 or len(self.track) < 2 or not (self.velocity or self.height is not None):
            return None
        sigma = self.scale_sigma_log if scale_sigma_log is None else scale_sigma_log
        at_s = stamps_s - self.delay_s
        per_scale_w = sigma * self.scale * p_m @ self.R_w_m.T
        parts = []
        if self.velocity:
            parts.append(self._displacements(at_s, p_m, per_scale_w))
        if self.height is not None:
            parts.append(heights(self.track, self.height, at_s, per_scale_w, self.T_b_c[:3, 3], self.delay_sigma_s))
        rows = stacked([part for part in parts if part is not None])
        guessed = np.zeros(len(stamps_s), dtype=bool) if guessed is None else guessed
        return None if rows is None else self._gaussian(rows, p_m, guessed)

    def up(self, stamps_s: FloatArray) -> UpDirections | None:
        """Gravity in frames at ``stamps_s`` ``(K,)``; None without attitude."""
        if len(self.track) < 2 or not (self.attitude and self.track.has_attitude):
            return None
        # Without parallax half a degree of lean looks like motion, and depths diverge.
        steady = not self.metric
        return up_directions(self.track, stamps_s - self.delay_s, self.T_b_c[:3, :3], self.R_w_m, steady)

    def leaning(self, stamps_s: FloatArray, R_c_m: FloatArray) -> NDArray[np.bool_]:
        """Which of the frames ``(K,)`` at ``stamps_s`` lean, by attitude, other than most of them.

        Args:
            stamps_s: Stamps ``(K,)`` [s].
            R_c_m: Map to camera ``(K, 3, 3)`` as the map has it.
        """
        leans, up = np.zeros(len(stamps_s), dtype=bool), self.up(stamps_s)
        if up is not None:
            up_m = np.einsum("kcm,kc->km", R_c_m[up.frame], up.up_c)
            most = np.median(up_m, axis=0)
            off_rad = np.linalg.norm(np.cross(up_m, most / np.linalg.norm(most)), axis=1)
            leans[up.frame] = off_rad > CONTRADICTS * math.sqrt(2.0) * ATTITUDE_RAD
        return leans

    def headings(self, stamps_s: FloatArray) -> Headings | None:
        """Headings of frames at increasing ``stamps_s`` ``(K,)``; None for fewer than two, or without metric scale."""
        if not (self.metric and self.attitude and self.track.has_attitude):
            return None
        return headings(self.track, stamps_s - self.delay_s, self.T_b_c[:3, :3], self.R_w_m, self.delay_sigma_s)

    def _displacements(self, at_s: FloatArray, p_m: FloatArray, per_scale_w: FloatArray) -> Rows | None:
        step, arm_b = self.config.velocity_step_m_s, self.T_b_c[:3, 3]
        p_w, gain = self.scale * p_m @ self.R_w_m.T, np.array(self.gain_sigma)
        return displacements(self.track, at_s, per_scale_w, p_w, gain, arm_b, step, self.truncates, self.delay_sigma_s)

    def _gaussian(self, rows: Rows, p_m: FloatArray, guessed: NDArray[np.bool_]) -> PositionGaussian:
        """Marginalise what does not contradict the map, with robust weights of its independent errors, and rotate to
        map axes."""
        D = np.einsum("mkw,wv->mkv", rows.D, self.R_w_m).reshape(len(rows.measured), -1) * self.scale
        residual = D @ p_m.ravel() - rows.measured
        slow = rows.slow + rows.common @ rows.common.T
        bent = np.where(
            np.abs(rows.D[:, guessed]).any(axis=(1, 2)), rows.way, _BENT * np.minimum(rows.way, np.median(rows.way))
        )
        allowed = rows.white + np.square(bent)
        used = np.flatnonzero(consistent(residual, slow + np.diag(allowed), rows.group))
        D, residual, measured, slow = D[used], residual[used], rows.measured[used], slow[np.ix_(used, used)]
        white, group = rows.white[used], np.unique(rows.group[used], return_inverse=True)[1]
        weight = np.ones(len(used))
        for _ in range(3):
            clean = residual - slow @ np.linalg.solve(slow + np.diag(white / weight), residual)
            tukey = tukey_weight(np.sqrt(np.bincount(group, clean**2 / allowed[used])), 1.0)
            weight = np.maximum(tukey, _LEAST_WEIGHT)[group]
        whitened = np.linalg.solve(slow + np.diag(white / weight), np.column_stack([D, measured]))
        A, count = D.T @ whitened[:, :-1], len(np.unique(rows.group))
        return PositionGaussian(
            0.5 * (A + A.T), D.T @ whitened[:, -1], float(measured @ whitened[:, -1]), count, count - len(tukey)
        )
