"""Poses: logarithms with derivatives, steps, and the refinement of one pose against fixed points."""

import math

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import FloatArray, IntArray

FAR_SIGMA = 1000.0
"""Residual of a point behind the camera [standard deviations]."""
_SERIES = np.array((-0.5, 1.0 / 12.0, 0.0, -1.0 / 720.0, 0.0, 1.0 / 30240.0))
"""B_n / n! for n = 1..6, of the inverse left Jacobian: for rotations below a radian."""


@compiled("f8[:,:,::1]")
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


@compiled("f8[:,:,::1], i8[::1], f8[:,::1]")
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


@compiled()
def _equations(
    T_c_w: FloatArray,
    p_w: FloatArray,
    uv: FloatArray,
    inv_sigma: FloatArray,
    slack: FloatArray,
    K: tuple[float, float, float, float],
    use: NDArray[np.bool_],
    robust: bool,
    limit: float,
    min_depth: float,
) -> tuple[FloatArray, FloatArray, float, FloatArray]:
    """Sum the normal equations over the points in use.

    Args:
        T_c_w: Pose ``(4, 4)``.
        p_w: Points ``(N, 3)``.
        uv: Their undistorted pixels ``(N, 2)``.
        inv_sigma: Inverse standard deviations ``(N,)`` [1/px].
        slack: Additional standard deviation along one direction ``(N, 2)`` [px].
        K: fx, fy, cx, cy [px].
        use: ``(N,)`` points in use.
        robust: Huber's kernel with threshold ``limit`` instead of squares.
        limit: Squared whitened residual.
        min_depth: Minimum depth of a point in front of the camera.

    Returns:
        Normal matrix ``(6, 6)``, gradient ``(6,)``, cost, and squared whitened residuals of all points ``(N,)``,
        infinite behind the camera.
    """
    fx, fy, cx, cy = K
    H, g, chi2, cost = np.zeros((6, 6)), np.zeros(6), np.full(len(uv), np.inf), 0.0
    delta = math.sqrt(limit)
    far = 2.0 * delta * FAR_SIGMA if robust else FAR_SIGMA * FAR_SIGMA
    J = np.zeros((2, 6))
    for n in range(len(uv)):
        p = p_w[n]
        X = T_c_w[0, 0] * p[0] + T_c_w[0, 1] * p[1] + T_c_w[0, 2] * p[2] + T_c_w[0, 3]
        Y = T_c_w[1, 0] * p[0] + T_c_w[1, 1] * p[1] + T_c_w[1, 2] * p[2] + T_c_w[1, 3]
        Z = T_c_w[2, 0] * p[0] + T_c_w[2, 1] * p[1] + T_c_w[2, 2] * p[2] + T_c_w[2, 3]
        if not min_depth < Z:
            cost += far if use[n] else 0.0
            continue
        iz = 1.0 / Z
        x, y = X * iz, Y * iz
        a, b = fx * inv_sigma[n], fy * inv_sigma[n]
        r, s = a * x + (cx - uv[n, 0]) * inv_sigma[n], b * y + (cy - uv[n, 1]) * inv_sigma[n]
        # Whitened by the inverse root of I + l l^T, which shortens components along l.
        u, v = slack[n, 0] * inv_sigma[n], slack[n, 1] * inv_sigma[n]
        length2 = u * u + v * v
        shorter = (1.0 - 1.0 / math.sqrt(1.0 + length2)) / length2 if length2 > 0.0 else 0.0
        along = (r * u + s * v) * shorter
        r, s = r - along * u, s - along * v
        square = r * r + s * s
        chi2[n] = square
        if not use[n]:
            continue
        weight = 1.0
        if robust and square > limit:
            norm = math.sqrt(square)
            weight = delta / norm
            cost += 2.0 * delta * norm - limit
        else:
            cost += square
        J[0, 0], J[0, 1], J[0, 2] = a * iz, 0.0, -a * x * iz
        J[0, 3], J[0, 4], J[0, 5] = -a * x * y, a * (1.0 + x * x), -a * y
        J[1, 0], J[1, 1], J[1, 2] = 0.0, b * iz, -b * y * iz
        J[1, 3], J[1, 4], J[1, 5] = -b * (1.0 + y * y), b * x * y, b * x
        for i in range(6):
            along = (J[0, i] * u + J[1, i] * v) * shorter
            J[0, i] -= along * u
            J[1, i] -= along * v
        for i in range(6):
            g[i] += weight * (J[0, i] * r + J[1, i] * s)
            for j in range(6):
                H[i, j] += weight * (J[0, i] * J[0, j] + J[1, i] * J[1, j])
    return H, g, cost, chi2


@compiled(
    "f8[:,::1], Tuple((f8[:,::1], f8[:,::1], f8[::1], f8[:,::1])), UniTuple(f8, 4), UniTuple(f8[:,:,::1], "
    "2), UniTuple(i8, 3), f8, UniTuple(f8, 2), f8, i8"
)
def refined(
    T_c_w: FloatArray,
    points: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    K: tuple[float, float, float, float],
    prior: tuple[FloatArray, FloatArray],
    rounds: tuple[int, int, int],
    chi2_max: float,
    tolerance: tuple[float, float],
    min_depth: float,
    min_points: int,
) -> tuple[FloatArray, FloatArray, FloatArray, int, int, bool]:
    """Damped, reweighted Gauss-Newton in rounds, see `optim.pose_only.refine_pose`.

    A step with a predicted decrease below the tolerance is applied without evaluating its cost: the prediction is the
    squared step length in standard deviations, a fraction of one, and the next round linearises there anyway.

    Args:
        T_c_w: Starting pose ``(4, 4)``.
        points: Points, pixels, inverse standard deviations and slack as those of `_equations`.
        K: fx, fy, cx, cy [px].
        prior: Expected poses ``(n, 4, 4)`` and their information ``(n, 6, 6)``; n is 0 or 1.
        rounds: Number of rounds, of those with a robust kernel, and of steps of each.
        chi2_max: Squared whitened residual of an outlier.
        tolerance: Largest tangent component, and relative decrease of the cost, that end a round.
        min_depth: Minimum depth of a point in front of the camera.
        min_points: Minimum number of inliers.

    Returns:
        Pose; normal matrix of the inliers ``(6, 6)``, NaN if the cost is not finite; squared whitened residuals
        ``(N,)``; number of inliers; number of steps; and whether the last round converged.
    """
    T, iterations, converged = T_c_w.copy(), 0, False
    use = np.ones(len(points[1]), np.bool_)
    count, one = len(use), np.zeros(1, np.int64)
    chi2 = np.full(len(use), np.inf)
    delta = np.zeros((1, 6))
    for k in range(rounds[0]):
        robust = k < rounds[1]
        converged = False
        H, g, cost, chi2 = _with_prior(T, points, K, prior, use, robust, chi2_max, min_depth)
        mu, used = 1e-6, 0
        while math.isfinite(cost) and used < rounds[2]:
            used += 1
            if not _solve(H, g, mu, delta[0]):
                break
            trial = stepped(T.reshape(1, 4, 4), one, delta)[0]
            predicted = 0.0
            for i in range(6):
                predicted -= g[i] * delta[0, i]
            if predicted <= tolerance[1] * cost:
                T, converged = trial, True
                break
            H_new, g_new, cost_new, chi2_new = _with_prior(trial, points, K, prior, use, robust, chi2_max, min_depth)
            small = np.abs(delta).max() < tolerance[0]
            if not cost_new <= cost:
                if small:
                    converged = True
                    break
                mu = max(10.0 * mu, 1e-3)
                continue
            flat = cost - cost_new <= tolerance[1] * cost
            T, H, g, cost, chi2, mu = trial, H_new, g_new, cost_new, chi2_new, 0.1 * mu
            if small or flat:
                converged = True
                break
        iterations += used
        same, count = True, 0
        for n in range(len(use)):
            inlier = chi2[n] <= chi2_max
            same = same and inlier == use[n]
            use[n] = inlier
            count += inlier
        if count < min_points or (same and converged and not robust):
            break
    H, g, cost, chi2 = _with_prior(T, points, K, prior, use, False, chi2_max, min_depth)
    if not math.isfinite(cost):
        H[:] = np.nan
    return T, H, chi2, count, iterations, converged


@compiled()
def _with_prior(
    T: FloatArray,
    points: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    K: tuple[float, float, float, float],
    prior: tuple[FloatArray, FloatArray],
    use: NDArray[np.bool_],
    robust: bool,
    limit: float,
    min_depth: float,
) -> tuple[FloatArray, FloatArray, float, FloatArray]:
    """`_equations` with those of the prior."""
    H, g, cost, chi2 = _equations(T, points[0], points[1], points[2], points[3], K, use, robust, limit, min_depth)
    E = np.zeros((1, 4, 4))
    E[0, 3, 3] = 1.0
    for n in range(len(prior[0])):
        for i in range(3):
            for j in range(3):
                for k in range(3):
                    E[0, i, j] += T[i, k] * prior[0][n, j, k]
        for i in range(3):
            E[0, i, 3] = T[i, 3]
            for j in range(3):
                E[0, i, 3] -= E[0, i, j] * prior[0][n, j, 3]
        e, J = logs(E)
        for i in range(6):
            for j in range(6):
                known = prior[1][n, i, j]
                cost += e[0, i] * known * e[0, j]
                for a in range(6):
                    g[a] += J[0, i, a] * known * e[0, j]
                    for b in range(6):
                        H[a, b] += J[0, i, a] * known * J[0, j, b]
    return H, g, cost, chi2


@compiled()
def _solve(H: FloatArray, g: FloatArray, mu: float, delta: FloatArray) -> bool:
    """Set ``delta (6,)`` to the damped step by Cholesky factorisation; False if the system is singular."""
    L = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            rest = H[i, j] * (1.0 + mu) if i == j else H[i, j]
            for k in range(j):
                rest -= L[i, k] * L[j, k]
            if i > j:
                L[i, j] = rest / L[j, j]
            elif rest > 0.0:
                L[i, i] = math.sqrt(rest)
            else:
                return False
    for i in range(6):
        delta[i] = -g[i]
        for k in range(i):
            delta[i] -= L[i, k] * delta[k]
        delta[i] /= L[i, i]
    for i in range(5, -1, -1):
        for k in range(i + 1, 6):
            delta[i] -= L[k, i] * delta[k]
        delta[i] /= L[i, i]
    return True
