"""Normal equations of poses and landmark blocks (anchors, inverse depths), Schur complement and back-substitution.

With residuals :math:`r`, derivatives :math:`J_x` by poses and :math:`J_y` by blocks, and robust weights :math:`w`,

.. math:: \\begin{pmatrix} H & W^T \\\\ W & V \\end{pmatrix} \\begin{pmatrix} \\delta \\\\ y \\end{pmatrix}
   = -\\begin{pmatrix} g_x \\\\ g_y \\end{pmatrix}, \\qquad V = \\sum w J_y^T J_y, \\quad W = \\sum w J_y^T J_x .

V is block-diagonal, so that the poses' steps follow from the Schur complement :math:`S = H - W^T V^{-1} W`.
"""

import math

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.types import FloatArray, IntArray

PIVOT = 1e-12
"""Pivot, relative to its diagonal entry, below which a direction is unobserved."""


@compiled()
def rho(s: float, delta: float) -> tuple[float, float]:
    """Huber's cost of a squared residual and its derivative, the weight, as `losses.robust.rho`."""
    if s <= delta * delta:
        return s, 1.0
    outside = math.sqrt(s)
    return delta * (2.0 * outside - delta), delta / outside


@compiled(
    "f8[:,::1], f8[:,:,::1], b1[::1], f8[::1], b1, f8, i8[::1], i8[::1], i8[::1], f8[:,:,::1], f8[:,::1], "
    "f8[:,:,::1], f8[:,::1], f8[:,:,::1]"
)
def accumulate(
    r: FloatArray,
    J: FloatArray,
    front: NDArray[np.bool_],
    far: FloatArray,
    joint: bool,
    delta: float,
    block: IntArray,
    view: IntArray,
    slot: IntArray,
    V: FloatArray,
    g: FloatArray,
    H: FloatArray,
    g_pose: FloatArray,
    W: FloatArray,
) -> float:
    """Add residuals to the normal equations and return their robust cost.

    Args:
        r: Whitened residuals ``(n, k)``.
        J: Their derivatives ``(n, k, 6 + m)`` by the pose and the block.
        front: ``(n,)`` which lie in front of the camera.
        far: ``(n,)`` squared residual assigned behind the camera, and the largest with a non-zero weight.
        joint: Whether the k rows are one measurement with a common weight, or have one each.
        delta: Width of Huber's kernel; infinite for plain squares.
        block: ``(n,)`` block of each residual.
        view: ``(n,)`` row of ``H`` and ``g_pose``; -1 for a fixed pose.
        slot: ``(n,)`` row of ``W``; not read where ``view`` is -1.
        V: ``(B, m, m)`` of the blocks, added to.
        g: ``(B, m)`` their gradients, added to.
        H: ``(F, 6, 6)`` of the poses, added to.
        g_pose: ``(F, 6)`` their gradients, added to.
        W: ``(S, m, 6)`` couplings of blocks and poses, added to.
    """
    n, rows, m = len(r), r.shape[1], J.shape[2] - 6
    cost, weights = 0.0, np.zeros(rows + 1)  # the last one stays zero: a partner for an odd row
    for e in range(n):
        square = 0.0
        for k in range(rows):
            square = square + r[e, k] * r[e, k] if joint else r[e, k] * r[e, k]
            weights[k] = 0.0
            if joint and k + 1 < rows:
                continue
            counts = front[e] and square < far[e]
            value, weight = rho(square if counts else far[e], delta)
            cost += value
            for i in range(0 if joint else k, k + 1):
                weights[i] = weight if counts else 0.0
        b, v, s = block[e], view[e], slot[e]
        for k in range(0, rows, 2):  # two rows at once: a sum in memory is read and written half as often
            l = min(k + 1, rows - 1)
            w, u = weights[k], weights[k + 1]
            if w == 0.0 and u == 0.0:
                continue
            for i in range(m):
                p, q = w * J[e, k, 6 + i], u * J[e, l, 6 + i]
                g[b, i] += p * r[e, k] + q * r[e, l]
                for j in range(m):
                    V[b, i, j] += p * J[e, k, 6 + j] + q * J[e, l, 6 + j]
                if v >= 0:
                    for j in range(6):
                        W[s, i, j] += p * J[e, k, j] + q * J[e, l, j]
            if v >= 0:
                for i in range(6):
                    p, q = w * J[e, k, i], u * J[e, l, i]
                    g_pose[v, i] += p * r[e, k] + q * r[e, l]
                    for j in range(6):
                        H[v, i, j] += p * J[e, k, j] + q * J[e, l, j]
    return cost


@compiled("f8[:,:,::1], f8[:,:,::1], i8[::1], i8[::1], i8[::1], i8[::1], f8[:,:,::1]")
def coupled(
    relative: FloatArray,
    adjoint: FloatArray,
    block: IntArray,
    view: IntArray,
    target_slot: IntArray,
    host_slot: IntArray,
    W: FloatArray,
) -> None:
    """Transform couplings with relative poses to couplings with hosts and targets: ``xi = xi_target - Ad xi_host``.

    Args:
        relative: ``(P, m, 6)`` couplings of pairs.
        adjoint: ``(R, 6, 6)`` of the relative poses.
        block: ``(P,)`` blocks.
        view: ``(P,)`` relative poses.
        target_slot: ``(P,)`` rows of ``W``; -1 for a fixed target.
        host_slot: ``(B,)`` the same for the hosts.
        W: ``(S, m, 6)``, added to.
    """
    for p in range(len(relative)):
        target, host = target_slot[p], host_slot[block[p]]
        for i in range(relative.shape[1]):
            for j in range(6):
                if target >= 0:
                    W[target, i, j] += relative[p, i, j]
                if host >= 0:
                    for k in range(6):
                        W[host, i, j] -= relative[p, i, k] * adjoint[view[p], k, j]


@compiled("f8[:,:,::1], f8[:,::1], f8[:,:,::1], i8[::1], i8[::1], f8, f8[:,::1], f8[::1]")
def eliminate(
    V: FloatArray,
    g: FloatArray,
    W: FloatArray,
    start: IntArray,
    column: IntArray,
    mu: float,
    S: FloatArray,
    right: FloatArray,
) -> FloatArray:
    """Eliminate blocks from the poses' system (Schur complement).

    Args:
        V: ``(B, m, m)``, where m is 1 or 3.
        g: ``(B, m)``.
        W: ``(S, m, 6)``, block by block.
        start: ``(B + 1,)`` first row of ``W`` of each block.
        column: ``(S,)`` pose of each row, ascending within a block.
        mu: Damping relative to the diagonal of ``V``.
        S: ``(6 F, 6 F)``; on and above its diagonal, ``W^T V^-1 W`` is subtracted.
        right: ``(6 F,)``; ``W^T V^-1 g`` is subtracted.

    Returns:
        ``(B, m, m)`` Cholesky factors of the damped blocks, below the diagonal; on it the pivots' reciprocal roots,
        zero in unobserved directions, which neither move nor affect the poses.
    """
    m = V.shape[1]
    factor = np.zeros(V.shape)
    most = 0
    for b in range(len(V)):
        most = max(most, start[b + 1] - start[b])
    Y, y = np.empty((most, m, 6)), np.empty(m)
    for b in range(len(V)):
        L = factor[b]
        for i in range(m):
            for j in range(i):
                rest = V[b, i, j]
                for k in range(j):
                    rest -= L[i, k] * L[j, k]
                L[i, j] = rest * L[j, j]
            full = V[b, i, i] * (1.0 + mu)
            rest = full
            for k in range(i):
                rest -= L[i, k] * L[i, k]
            L[i, i] = 1.0 / math.sqrt(rest) if rest > PIVOT * full else 0.0
        first, count = start[b], start[b + 1] - start[b]
        for i in range(m):  # y = L^-1 g and Y = L^-1 W
            y[i] = g[b, i]
            for k in range(i):
                y[i] -= L[i, k] * y[k]
            y[i] *= L[i, i]
            for s in range(count):
                for c in range(6):
                    rest = W[first + s, i, c]
                    for k in range(i):
                        rest -= L[i, k] * Y[s, k, c]
                    Y[s, i, c] = rest * L[i, i]
        for s in range(count):
            row = 6 * column[first + s]
            for i in range(m):
                for c in range(6):
                    right[row + c] -= Y[s, i, c] * y[i]
            for t in range(s, count):
                to, A, B = 6 * column[first + t], Y[s], Y[t]
                for c in range(6):
                    S_row = S[row + c]
                    if m == 3:  # unrolled: half the time of a loop
                        u, v, w = A[0, c], A[1, c], A[2, c]
                        for d in range(6):
                            S_row[to + d] -= u * B[0, d] + v * B[1, d] + w * B[2, d]
                    else:
                        for d in range(6):
                            S_row[to + d] -= A[0, c] * B[0, d]
    return factor


@compiled("f8[:,:,::1], f8[:,::1], f8[:,:,::1], i8[::1], i8[::1], f8[:,::1]")
def back_substitute(
    factor: FloatArray, g: FloatArray, W: FloatArray, start: IntArray, column: IntArray, delta: FloatArray
) -> FloatArray:
    """Steps of the blocks ``(B, m)`` for the poses' ``delta (F, 6)``: ``-V^-1 (g + W delta)``."""
    m = g.shape[1]
    step = np.empty(g.shape)
    for b in range(len(g)):
        L, x = factor[b], step[b]
        for i in range(m):
            x[i] = -g[b, i]
            for s in range(start[b], start[b + 1]):
                for c in range(6):
                    x[i] -= W[s, i, c] * delta[column[s], c]
        for i in range(m):
            for k in range(i):
                x[i] -= L[i, k] * x[k]
            x[i] *= L[i, i]
        for i in range(m - 1, -1, -1):
            for k in range(i + 1, m):
                x[i] -= L[k, i] * x[k]
            x[i] *= L[i, i]
    return step


@compiled("f8[:,::1], f8[::1]")
def solve_triangular(U: FloatArray, right: FloatArray) -> FloatArray:
    """Solution ``(n,)`` of ``U^T U x = right`` for an upper triangular ``U`` ``(n, n)``."""
    x = right.copy()
    for i in range(len(x)):
        x[i] /= U[i, i]
        for j in range(i + 1, len(x)):
            x[j] -= U[i, j] * x[i]
    for i in range(len(x) - 1, -1, -1):
        for j in range(i + 1, len(x)):
            x[i] -= U[i, j] * x[j]
        x[i] /= U[i, i]
    return x
