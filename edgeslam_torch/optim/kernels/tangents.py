"""Steps of poses, and logarithms of rigid motions with their derivatives, for priors on poses."""

import math

import numpy as np

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import FloatArray, IntArray

_SERIES = np.array((-0.5, 1.0 / 12.0, 0.0, -1.0 / 720.0, 0.0, 1.0 / 30240.0))
"""B_n / n! for n = 1..6, of the inverse left Jacobian: for rotations below a radian."""


@compiled
def logs(E: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Tangents of rigid motions and their derivatives by a left perturbation.

    Args:
        E: Rigid motions ``(n, 4, 4)``, as of a pose relative to the expected one.

    Returns:
        Tangents ``(n, 6)``, translation first, and ``(n, 6, 6)`` J with ``log(exp(d) E) = log(E) + J d``.
    """
    xi, J = np.zeros((len(E), 6)), np.zeros((len(E), 6, 6))
    ad, power, product, phi = np.zeros((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty(3)
    for n in range(len(E)):
        T = E[n]
        trace = T[0, 0] + T[1, 1] + T[2, 2]
        # The quaternion, by its largest component (Shepperd 1978).
        a = 0
        for i in range(1, 3):
            if T[i, i] > T[a, a]:
                a = i
        b, c = (a + 1) % 3, (a + 2) % 3
        if trace > T[a, a]:
            w = 1.0 + trace
            phi[0], phi[1], phi[2] = T[2, 1] - T[1, 2], T[0, 2] - T[2, 0], T[1, 0] - T[0, 1]
        else:
            w = T[c, b] - T[b, c]
            phi[a] = 1.0 + T[a, a] - T[b, b] - T[c, c]
            phi[b], phi[c] = T[b, a] + T[a, b], T[c, a] + T[a, c]
        size = math.sqrt(w * w + phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
        size = -size if w < 0.0 else size
        sine = math.sqrt(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]) / abs(size)
        theta = 2.0 * math.atan2(sine, w / size)
        turn = (theta / sine if sine > 1e-9 else 2.0) / size
        x, y, z = turn * phi[0], turn * phi[1], turn * phi[2]
        half = 0.5 * theta
        curl = 1.0 / 12.0 if theta < 1e-4 else (1.0 - half / math.tan(half)) / (theta * theta)
        u, v, s = T[0, 3], T[1, 3], T[2, 3]
        along, rest = curl * (x * u + y * v + z * s), 1.0 - curl * theta * theta
        xi[n, 0] = rest * u - 0.5 * (y * s - z * v) + along * x
        xi[n, 1] = rest * v - 0.5 * (z * u - x * s) + along * y
        xi[n, 2] = rest * s - 0.5 * (x * v - y * u) + along * z
        xi[n, 3], xi[n, 4], xi[n, 5] = x, y, z
        for k in (0, 3):  # the adjoint's derivative: [phi] [rho] over 0 [phi], cross-product matrices
            ad[k, k + 1], ad[k, k + 2], ad[k + 1, k + 2] = -z, y, -x
            ad[k + 1, k], ad[k + 2, k], ad[k + 2, k + 1] = z, -y, x
        ad[0, 4], ad[0, 5], ad[1, 5] = -xi[n, 2], xi[n, 1], -xi[n, 0]
        ad[1, 3], ad[2, 3], ad[2, 4] = xi[n, 2], -xi[n, 1], xi[n, 0]
        for i in range(6):
            for j in range(6):
                power[i, j] = 1.0 if i == j else 0.0
            J[n, i, i] = 1.0
        for m in range(len(_SERIES)):
            for i in range(6):
                for j in range(6):
                    total = 0.0
                    for k in range(6):
                        total += power[i, k] * ad[k, j]
                    product[i, j] = total
            for i in range(6):
                for j in range(6):
                    power[i, j] = product[i, j]
                    J[n, i, j] += _SERIES[m] * product[i, j]
    return xi, J


@compiled
def stepped(T: FloatArray, pose: IntArray, xi: FloatArray) -> FloatArray:
    """Poses ``(W, 4, 4)`` after left tangents ``(n, 6)`` of some ``(n,)`` of them, see `geometry.se3.exp`."""
    out, E = T.copy(), np.empty((3, 4))
    for n in range(len(pose)):
        u, v, w, x, y, z = xi[n]
        theta2 = x * x + y * y + z * z
        theta = math.sqrt(theta2)
        if theta < 1e-3:
            a = 1.0 - theta2 / 6.0 + theta2 * theta2 / 120.0
            b = 0.5 - theta2 / 24.0 + theta2 * theta2 / 720.0
            c = 1.0 / 6.0 - theta2 / 120.0 + theta2 * theta2 / 5040.0
        else:
            a, b, c = math.sin(theta) / theta, (1.0 - math.cos(theta)) / theta2, (theta - math.sin(theta)) / theta**3
        p, q, r = y * w - z * v, z * u - x * w, x * v - y * u
        along, rest = c * (x * u + y * v + z * w), 1.0 - c * theta2
        E[0, 0], E[0, 1], E[0, 2] = 1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y
        E[1, 0], E[1, 1], E[1, 2] = b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x
        E[2, 0], E[2, 1], E[2, 2] = b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)
        E[0, 3], E[1, 3] = rest * u + b * p + along * x, rest * v + b * q + along * y
        E[2, 3] = rest * w + b * r + along * z
        for i in range(3):
            for j in range(4):
                total = E[i, 3] if j == 3 else 0.0
                for k in range(3):
                    total += E[i, k] * T[pose[n], k, j]
                out[pose[n], i, j] = total
    return out
