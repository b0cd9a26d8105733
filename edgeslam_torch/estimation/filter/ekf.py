r"""Extended Kalman filter of the drone's position and attitude, paper eqs. (8)-(14).

The state is :math:`x = (p, \alpha)`, position and roll-pitch-yaw in the power-on world, eq. (8); augmented by a
velocity bias and a clone, the pose of the body at the last visual update. The clone is propagated by visual
increments and compared with the pose. Thus the jitter of a visual pose counts once, instead of in the increments
before and after it, as if they were independent; only the drift of the map accumulates.

Note:
    The printed filter and the corrected default differ in seven points (docs/theory/sensors.md);
    ``FusionConfig.literal`` selects the printed one.
"""

import math
from copy import copy
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.gate import exceedance
from edgeslam_torch.geometry.rotations import (
    euler_rate_matrix,
    matrix_from_rpy,
    rotation_vector,
    rpy_from_matrix,
)
from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.noise import (
    ATTITUDE_RAD,
    ATTITUDE_WALK_RAD_SQRT_S,
    FIRST_ATTITUDE_RAD,
    POSITION_FLOOR_M_SQRT_S,
    VELOCITY_BIAS_WALK_M_S_SQRT_S,
    VELOCITY_M_S,
)
from edgeslam_torch.types import FloatArray

_P, _A, _B = slice(0, 3), slice(3, 6), slice(6, 9)
_POSE, _CLONE = slice(0, 6), slice(9, 15)
_CLONE_P, _CLONE_A = slice(9, 12), slice(12, 15)
_SIZE = 15
_NO_RATE = np.zeros(3)
_UNLIKELY = 0.05
"""Probability of a measurement's normalised innovation squared below which it is refused."""
RECOVERS_AFTER = 5
"""Refusals in a row after which the covariance is inflated and the measurement taken."""
_BLIND_S = 0.5
"""Time without vision after which zero readings are taken as hover; longer than a late video's gap."""


class Outcome(StrEnum):
    """Outcome of a measurement."""

    ACCEPTED = "accepted"
    REFUSED = "refused"
    RECOVERED = "recovered"
    NO_CLONE = "no clone"
    NOT_FINITE = "not finite"


@dataclass(frozen=True, slots=True)
class Relative:
    """Motion of the body since the last visual update, in its axes at that time."""

    T: FloatArray
    """``(4, 4)`` pose [m]."""
    velocity_m_s: FloatArray
    """``(3,)``"""
    covariance: FloatArray
    """``(9, 9)`` of translation [m], rotation vector [rad] and velocity [m/s]."""


class Ekf:
    """The filter at one moment, with the readings that are valid there; `BufferedEkf` takes late measurements."""

    def __init__(self, config: FusionConfig) -> None:
        self.config = config
        self.x: FloatArray = np.zeros(_SIZE)
        self.P: FloatArray = np.zeros((_SIZE, _SIZE))
        self.P[range(3, 6), range(3, 6)] = FIRST_ATTITUDE_RAD**2
        if config.sigma_bias_m_s > 0 and not config.literal:
            self.P[range(6, 9), range(6, 9)] = config.sigma_bias_m_s**2
        self.tau_s = 0.0
        """Time since the last visual update, paper eq. (10)."""
        self.refused_in_row = {3: 0, 6: 0}
        """Consecutive refusals of attitude (3 components) and of vision (6)."""
        self.velocity: FloatArray = np.zeros(3)
        self.ranged = False
        self.battery = math.nan
        """Of the newest reading; the velocity is interpolated between two, ``ranged`` where heights give its vertical
        component, which has no bias."""
        self.read_rpy_rad: FloatArray = np.full(3, math.nan)
        self.read_rate: FloatArray = np.zeros(3)
        self.read_s = math.nan
        """Attitude reading, its rate against the one before [rad/s], and its stamp."""
        self.clone_s = math.nan
        """Stamp of the clone."""

    @property
    def p_w(self) -> FloatArray:
        """Position of the body in the power-on world ``(3,)`` [m]."""
        return self.x[_P]

    @property
    def rpy_rad(self) -> FloatArray:
        """Its roll, pitch, yaw ``(3,)``."""
        return self.x[_A]

    @property
    def velocity_bias_m_s(self) -> FloatArray:
        """``(3,)``, in the frame of the velocity readings."""
        return self.x[_B]

    @property
    def covariance(self) -> FloatArray:
        """``(6, 6)`` of position [m] and angles [rad]."""
        return self.P[_POSE, _POSE]

    def copy(self) -> "Ekf":
        """An independent copy."""
        other = copy(self)
        other.x, other.P, other.refused_in_row = self.x.copy(), self.P.copy(), dict(self.refused_in_row)
        return other

    def reset_pose(self, p_w: FloatArray, rpy_rad: FloatArray) -> None:
        """Start at a given pose with the initial uncertainty."""
        self.x[_P], self.x[_A] = p_w, rpy_rad
        self.clone()

    def predict(
        self, dt_s: float, velocity_m_s: FloatArray, battery: float = math.nan, rpy_rate_rad_s: FloatArray = _NO_RATE
    ) -> None:
        """Propagate by a velocity reading over ``dt_s``, paper eqs. (9)-(10).

        Args:
            dt_s: Time step [s].
            velocity_m_s: Reading ``(3,)`` in ``config.velocity_frame``.
            battery: Charge in [0, 1]; NaN counts as full.
            rpy_rate_rad_s: Rates of roll, pitch and yaw ``(3,)`` by the attitude readings around; the printed filter
                has none.
        """
        self.tau_s += dt_s
        spent = 1.0 - battery if battery == battery else 0.0
        config, x, P = self.config, self.x, self.P
        velocity = velocity_m_s - self._bias(velocity_m_s)
        if config.velocity_frame == "body":
            R = matrix_from_rpy(x[_A])
            moved = R.dot(velocity)
            A = np.empty((3, 6))
            A[:, :3] = dt_s * _cross_columns(euler_rate_matrix(x[_A]), moved)
            A[:, 3:] = -dt_s * R
            P[_P] += A.dot(P[3:9])
            P[:, _P] += P[:, 3:9].dot(A.T)
        else:
            moved = velocity
            P[_P] -= dt_s * P[_B]
            P[:, _P] -= dt_s * P[:, _B]
        x[_P] += dt_s * moved
        diagonal = P.ravel()[:: _SIZE + 1]
        if config.literal:
            diagonal[_POSE] += config.literal_beta * (spent + config.lambda_tau * self.tau_s)
            return
        growth = 1.0 + config.beta * spent + config.lambda_tau * min(self.tau_s, 60.0)
        position = dt_s * (0.1 * VELOCITY_M_S**2 * growth + POSITION_FLOOR_M_SQRT_S**2)
        x[_A] += dt_s * rpy_rate_rad_s
        turning = dt_s * ATTITUDE_WALK_RAD_SQRT_S**2
        bias = dt_s * VELOCITY_BIAS_WALK_M_S_SQRT_S**2 * growth if config.sigma_bias_m_s > 0 else 0.0
        # A reading's error lasts as long as the reading, 0.1 s: dt * 0.1 s of variance, not dt^2.
        diagonal[_P] += position
        diagonal[_A] += turning
        diagonal[_B] += bias

    def _bias(self, velocity_m_s: FloatArray) -> FloatArray:
        """Velocity bias to subtract from a reading ``(3,)``; zero for zero readings and for heights after some time
        without vision.

        The bias estimated in flight is mostly quantisation loss; subtracting it from the readings of a hovering drone
        would make it drift.
        """
        if self.tau_s < _BLIND_S:
            return self.x[_B]
        return np.where((velocity_m_s == 0.0) | [False, False, self.ranged], 0.0, self.x[_B])

    def update_attitude(self, rpy_rad: FloatArray) -> Outcome:
        """Euler angles from the drone, paper eqs. (11)-(12)."""
        residual = rpy_rad - self.x[_A]
        if not self.config.literal:
            _wrap_in_place(residual, (0, 1, 2))
        P_Ht = self.P[:, _A]
        return self._update(P_Ht, P_Ht[_A].copy(), residual, np.full(3, ATTITUDE_RAD**2))

    def update_absolute(self, p_w: FloatArray, rpy_rad: FloatArray, sigma_t_m: float, sigma_r_rad: float) -> Outcome:
        """Accumulated visual pose as a full-state measurement, paper eqs. (13)-(14)."""
        residual = np.concatenate([p_w - self.x[_P], rpy_rad - self.x[_A]])
        if not self.config.literal:
            _wrap_in_place(residual, (3, 4, 5))
        P_Ht = self.P[:, _POSE]
        outcome = self._update(P_Ht, P_Ht[_POSE].copy(), residual, _pose_noise(sigma_t_m, sigma_r_rad))
        self._after_visual(outcome)
        return outcome

    def clone(self) -> None:
        """Clone the filter's pose at the start of vision, without new information."""
        self.x[_CLONE] = self.x[_POSE]
        self.P[_CLONE] = self.P[_POSE]
        self.P[:, _CLONE] = self.P[:, _POSE]

    def carry_clone(self, T: FloatArray, sigma_t_m: float, sigma_r_rad: float) -> None:
        r"""Move the clone by a visual increment, :math:`\Delta T_{rel}` of paper eq. (13).

        Args:
            T: Body pose in the cloned body frame ``(4, 4)`` [m].
            sigma_t_m: Drift of its translation [m], per axis.
            sigma_r_rad: Drift of its rotation [rad], per axis.
        """
        x, P = self.x, self.P
        R = matrix_from_rpy(x[_CLONE_A])
        E = euler_rate_matrix(x[_CLONE_A])
        moved = R.dot(T[:3, 3])
        x[_CLONE_P] += moved
        x[_CLONE_A] = rpy_from_matrix(R.dot(T[:3, :3]))
        to_rates = np.linalg.inv(euler_rate_matrix(x[_CLONE_A]))
        G = np.eye(6)  # derivative of the clone's change by its previous error
        G[:3, 3:] = _cross_columns(E, moved)
        G[3:, 3:] = to_rates.dot(E)
        P[_CLONE] = G.dot(P[_CLONE])
        P[:, _CLONE] = P[:, _CLONE].dot(G.T)
        P[_CLONE_P, _CLONE_P] += sigma_t_m**2 * np.eye(3)
        P[_CLONE_A, _CLONE_A] += sigma_r_rad**2 * to_rates.dot(to_rates.T)

    def update_relative(self, T_clone_b: FloatArray, sigma_t_m: float, sigma_r_rad: float) -> Outcome:
        """Motion since the clone, which is unchanged; the identity constrains the body to the clone up to the jitter of
        one visual pose.

        Args:
            T_clone_b: Body pose in the cloned body frame [m], shape ``(4, 4)``.
            sigma_t_m: Standard deviation of its translation [m], per axis.
            sigma_r_rad: Standard deviation of its rotation [rad], per axis.
        """
        residual, H = _relative(self.x, T_clone_b)
        P_Ht = self.P.dot(H.T)
        outcome = self._update(P_Ht, H.dot(P_Ht), residual, _pose_noise(sigma_t_m, sigma_r_rad))
        self._after_visual(outcome)
        return outcome

    def since_clone(self) -> "Relative":
        """Pose and velocity in the body axes of the last visual update."""
        x, config = self.x, self.config
        seen, H = _relative(x, np.eye(4))
        R_c = matrix_from_rpy(x[_CLONE_A])
        T = np.eye(4)
        T[:3, :3] = R_c.T @ matrix_from_rpy(x[_A])
        T[:3, 3] = -seen[:3]
        bias = np.zeros(3) if config.literal else x[_B]
        turned = matrix_from_rpy(x[_A]) if config.velocity_frame == "body" else np.eye(3)
        velocity_w = turned @ (self.velocity - bias)
        J = np.zeros((9, _SIZE))
        J[:6] = H
        J[6:, _B] = -R_c.T @ turned
        J[6:, _CLONE_A] = -R_c.T @ _cross_columns(euler_rate_matrix(x[_CLONE_A]), velocity_w)
        covariance = J @ self.P @ J.T
        covariance[range(6, 9), range(6, 9)] += VELOCITY_M_S**2
        return Relative(T, R_c.T @ velocity_w, 0.5 * (covariance + covariance.T))

    def _after_visual(self, outcome: Outcome) -> None:
        if outcome in (Outcome.ACCEPTED, Outcome.RECOVERED):
            self.tau_s = 0.0

    def _update(self, P_Ht: FloatArray, S: FloatArray, residual: FloatArray, noise: FloatArray) -> Outcome:
        """Gate and apply one measurement; ``P_Ht`` is ``P H^T`` ``(15, n)`` and ``S`` its ``H P H^T`` ``(n, n)``."""
        n = len(residual)
        if not math.isfinite(residual.dot(residual)):
            return Outcome.NOT_FINITE
        S.ravel()[:: n + 1] += noise
        gain, weighted = _solved(S, P_Ht, residual)
        distance = float(residual.dot(weighted))
        outcome = Outcome.ACCEPTED
        if not self.config.literal and exceedance(distance, n) < _UNLIKELY:
            self.refused_in_row[n] += 1
            if self.refused_in_row[n] < RECOVERS_AFTER:
                return Outcome.REFUSED
            outcome = Outcome.RECOVERED
            # The filter was overconfident: inflate the observed subspace according to the innovation. Inflating all of
            # the covariance would let it grow without bound, as the absolute position is unobservable.
            grown = min(distance / n, 1e4) - 1.0
            known = S.copy()
            known.ravel()[:: n + 1] -= noise
            along = np.eye(n) + grown * np.linalg.solve(S, known)
            self.P = self.P + grown * P_Ht.dot(gain)
            P_Ht, S = P_Ht.dot(along), known.dot(along)
            S = 0.5 * (S + S.T)
            S.ravel()[:: n + 1] += noise
            gain, weighted = _solved(S, P_Ht, residual)
        self.refused_in_row[n] = 0
        self.x += P_Ht.dot(weighted)
        P = self.P - P_Ht.dot(gain)
        self.P = 0.5 * (P + P.T)
        if not self.config.literal:
            _wrap_in_place(self.x, (3, 4, 5, 12, 13, 14))
            # Quantisation loss is below one step. A larger bias comes from a wrong map and must not persist after it.
            np.clip(self.x[_B], -self.config.velocity_step_m_s, self.config.velocity_step_m_s, out=self.x[_B])
        return outcome


def _relative(x: FloatArray, T_clone_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    r"""Innovation of a measured body pose in the cloned body frame ``(4, 4)``, and its derivative.

    .. math:: T_{clone,b} = T_c^{-1} T, \quad h_t = R_c^T (p - p_c), \quad h_R = R_c^T R

    Returns:
        Measured minus predicted translation [m] and rotation vector [rad] ``(6,)``, and the derivative of the
        prediction by the state ``(6, 15)``.
    """
    R_c, R = matrix_from_rpy(x[_CLONE_A]), matrix_from_rpy(x[_A])
    moved = R_c.T @ (x[_P] - x[_CLONE_P])
    clone_rates = R_c.T @ euler_rate_matrix(x[_CLONE_A])  # in body axes
    H = np.zeros((6, _SIZE))
    H[:3, _P], H[:3, _CLONE_P], H[:3, _CLONE_A] = R_c.T, -R_c.T, hat(moved) @ clone_rates
    H[3:, _A], H[3:, _CLONE_A] = R_c.T @ euler_rate_matrix(x[_A]), -clone_rates
    turned = T_clone_b[:3, :3] @ R.T @ R_c
    return np.concatenate([T_clone_b[:3, 3] - moved, rotation_vector(turned)]), H


def _solved(S: FloatArray, P_Ht: FloatArray, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """``S^-1 H P`` ``(n, 15)`` and ``S^-1 residual`` ``(n,)`` by one factorisation."""
    columns = np.empty((len(residual), _SIZE + 1))
    columns[:, :_SIZE] = P_Ht.T
    columns[:, _SIZE] = residual
    try:
        solution = np.linalg.solve(S, columns)
    except np.linalg.LinAlgError:  # singular, from rounding errors only
        solution = np.linalg.lstsq(S, columns, rcond=None)[0]
    return solution[:, :_SIZE], solution[:, _SIZE]


def _wrap_in_place(x: FloatArray, indices: tuple[int, ...]) -> None:
    values = x.tolist()
    for i in indices:
        if not -math.pi <= values[i] < math.pi:
            x[i] = (values[i] + math.pi) % (2.0 * math.pi) - math.pi


def _pose_noise(sigma_t_m: float, sigma_r_rad: float) -> FloatArray:
    noise = np.empty(6)
    noise[:3], noise[3:] = sigma_t_m**2, sigma_r_rad**2
    return noise


def _cross_columns(E: FloatArray, v: FloatArray) -> FloatArray:
    """Columns ``E[:, k] x v``: derivative of the rotated ``v`` by each Euler angle, shape ``(3, 3)``."""
    x, y, z = float(v[0]), float(v[1]), float(v[2])
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]) @ E
