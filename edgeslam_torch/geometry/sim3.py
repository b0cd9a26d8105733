"""Similarities ``p' = s R p + t``: transforms between submaps of a monocular map.

Tangents are ``(rho, phi, sigma)``: translation, rotation, log of the scale, applied on the left (Strasdat, Montiel and
Davison, RSS 2010). A similarity is a ``(4, 4)`` matrix with ``s R`` in its upper left block, so that products and
inverses are those of matrices.
"""

import numpy as np

from edgeslam_torch.geometry.rotations import matrices_from_vectors, vectors_from_matrices
from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.types import FloatArray

SMALL = 1e-5
"""Angle [rad] and log scale below which series replace ill-conditioned quotients."""


def compose(scale: float, R: FloatArray, t: FloatArray) -> FloatArray:
    """``(4, 4)`` from a scale, a rotation ``(3, 3)`` and a translation ``(3,)``."""
    S = np.eye(4)
    S[:3, :3] = scale * R
    S[:3, 3] = t
    return S


def scale_of(S: FloatArray) -> float:
    """Scale of a similarity ``(4, 4)``."""
    return float(np.cbrt(np.linalg.det(S[:3, :3])))


def parts(S: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Scale, rotation ``(3, 3)`` and translation ``(3,)`` of a similarity."""
    scale = scale_of(S)
    return scale, S[:3, :3] / scale, S[:3, 3]


def inverse(S: FloatArray) -> FloatArray:
    """Inverse of a similarity ``(4, 4)``."""
    scale, R, t = parts(S)
    return compose(1.0 / scale, R.T, -(R.T @ t) / scale)


def transform(S: FloatArray, p: FloatArray) -> FloatArray:
    """Points ``(N, 3)`` transformed by a similarity."""
    return p @ S[:3, :3].T + S[:3, 3]


def moved_camera(S: FloatArray, T_c_w: FloatArray) -> FloatArray:
    """``T_c_w`` of a camera whose world was transformed by a similarity; the scale affects its translation only."""
    scale, R, t = parts(S)
    T = np.eye(4)
    T[:3, :3] = T_c_w[:3, :3] @ R.T
    T[:3, 3] = scale * T_c_w[:3, 3] - T[:3, :3] @ t
    return T


def exp(xi: FloatArray) -> FloatArray:
    """Similarities ``(..., 4, 4)`` of tangents ``(..., 7)``.

    Example:
        >>> round(float(exp(np.array([0.0, 0, 0, 0, 0, 0, np.log(2.0)]))[0, 0]), 12)
        2.0
    """
    rho, phi, sigma = xi[..., :3], xi[..., 3:6], xi[..., 6]
    S = np.zeros((*xi.shape[:-1], 4, 4))
    S[..., :3, :3] = np.exp(sigma)[..., None, None] * matrices_from_vectors(phi)
    S[..., :3, 3] = (_left(phi, sigma) @ rho[..., None])[..., 0]
    S[..., 3, 3] = 1.0
    return S


def log(S: FloatArray) -> FloatArray:
    """Tangents ``(..., 7)`` of similarities; inverse of `exp` for angles below pi."""
    scale = np.cbrt(np.linalg.det(S[..., :3, :3]))
    phi, sigma = vectors_from_matrices(S[..., :3, :3] / scale[..., None, None]), np.log(scale)
    rho = np.linalg.solve(_left(phi, sigma), S[..., :3, 3:])[..., 0]
    return np.concatenate([rho, phi, sigma[..., None]], axis=-1)


def _left(phi: FloatArray, sigma: FloatArray) -> FloatArray:
    """Integral of ``exp(u (sigma + hat(phi)))`` over ``u`` from 0 to 1, ``(..., 3, 3)``: maps rho to t."""
    theta, scale = np.linalg.norm(phi, axis=-1), np.exp(sigma)
    # Integrals of exp(u sigma), and of it times sin(u theta) / theta and times (1 - cos(u theta)) / theta^2.
    safe = np.where(np.abs(sigma) > SMALL, sigma, 1.0)
    whole = np.where(np.abs(sigma) > SMALL, np.expm1(safe) / safe, 1.0 + 0.5 * sigma)
    turned = theta > SMALL
    t = np.where(turned, theta, 1.0)
    both = sigma**2 + t**2
    sine = (scale * (sigma * np.sin(t) - t * np.cos(t)) + t) / both
    cosine = (scale * (sigma * np.cos(t) + t * np.sin(t)) - sigma) / both
    # Integral of u exp(u sigma), its limit.
    wide = np.where(np.abs(sigma) > 1e-3, sigma, 1.0)
    slow = np.where(np.abs(sigma) > 1e-3, (scale * (wide - 1.0) + 1.0) / wide**2, 0.5 + sigma / 3.0)
    first = np.where(turned, sine / t, slow)[..., None, None]
    second = np.where(turned, (whole - cosine) / t**2, 0.0)[..., None, None]
    turn = hat(phi)
    return whole[..., None, None] * np.eye(3) + first * turn + second * (turn @ turn)
