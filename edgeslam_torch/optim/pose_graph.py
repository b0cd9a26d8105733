r"""Pose graph of similarities: distributes the drift measured by a loop closure over the map.

A node is the similarity :math:`S_i` that takes the world to keyframe i, an edge a measurement between two of them.
With the error :math:`E = S_{ij} S_j S_i^{-1}` the residual is :math:`\log E`, in seven numbers (Strasdat, Montiel and
Davison, RSS 2010). All edges but those that close a loop agree with the map as it is, so the way back of an
inconsistent loop is shared by its edges in proportion to their uncertainty.
"""

from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import sim3
from edgeslam_torch.geometry.se3 import hat
from edgeslam_torch.types import FloatArray, IntArray

ITERATIONS = 30
DONE = 1e-10
"""Largest component of a step at which the solver stops."""
DAMPING = 1e-9
"""Initial damping relative to the diagonal: the problem is nearly linear."""


@dataclass(frozen=True, slots=True)
class PoseGraph:
    """Keyframes and the measurements between them."""

    S: FloatArray
    """``(N, 4, 4)`` similarities, world to keyframe."""
    fixed: IntArray
    """Nodes that fix the gauge."""
    i: IntArray
    j: IntArray
    """``(E,)`` the nodes of each edge."""
    S_ij: FloatArray
    """``(E, 4, 4)`` measured similarity that takes coordinates of keyframe ``j`` to those of keyframe ``i``."""
    inv_sigma: FloatArray
    """``(E, 7)`` inverse standard deviations of translation, rotation and log scale."""


def solve(graph: PoseGraph) -> FloatArray:
    """Nodes ``(N, 4, 4)`` that minimise the weighted squared residuals, by Levenberg-Marquardt."""
    S, damping = graph.S.copy(), DAMPING
    r = residuals(graph, S)
    for _ in range(ITERATIONS):
        step = _step(graph, r, damping)
        moved = sim3.exp(step) @ S
        r_moved = residuals(graph, moved)
        if _cost(graph, r_moved) <= _cost(graph, r):
            S, r, damping = moved, r_moved, damping / 10.0
        else:
            damping = 10.0 * max(damping, 1e-6)
        if np.abs(step).max() < DONE:
            break
    return S


def residuals(graph: PoseGraph, S: FloatArray) -> FloatArray:
    """Tangents ``(E, 7)`` of the errors, unweighted, for nodes ``(N, 4, 4)``."""
    return sim3.log(graph.S_ij @ S[graph.j] @ np.linalg.inv(S[graph.i]))


def jacobians(graph: PoseGraph, r: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives ``(E, 7, 7)`` of the residuals ``(E, 7)`` by left tangents of node ``i`` and of node ``j``."""
    ad = small_adjoint(r)
    square = ad @ ad
    even = np.eye(7) + square / 12.0 - square @ square / 720.0 + square @ square @ square / 30240.0
    # By node i the error is multiplied on the right, by node j on the left.
    return -(even + 0.5 * ad), (even - 0.5 * ad) @ adjoint(graph.S_ij)


def adjoint(S: FloatArray) -> FloatArray:
    """``(E, 7, 7)`` with ``S exp(xi) S^-1 = exp(Ad xi)`` for similarities ``(E, 4, 4)``."""
    t = S[:, :3, 3]
    scaled = S[:, :3, :3]
    R = scaled / np.cbrt(np.linalg.det(scaled))[:, None, None]
    out = np.zeros((len(S), 7, 7))
    out[:, :3, :3] = scaled
    out[:, :3, 3:6] = hat(t) @ R
    out[:, :3, 6] = -t
    out[:, 3:6, 3:6] = R
    out[:, 6, 6] = 1.0
    return out


def small_adjoint(xi: FloatArray) -> FloatArray:
    """``(E, 7, 7)`` derivative of `adjoint` at the identity in the direction of tangents ``(E, 7)``."""
    rho, phi, sigma = xi[:, :3], xi[:, 3:6], xi[:, 6]
    out = np.zeros((len(xi), 7, 7))
    out[:, :3, :3] = hat(phi) + sigma[:, None, None] * np.eye(3)
    out[:, :3, 3:6] = hat(rho)
    out[:, :3, 6] = -rho
    out[:, 3:6, 3:6] = hat(phi)
    return out


def _step(graph: PoseGraph, r: FloatArray, damping: float) -> FloatArray:
    """Tangents ``(N, 7)`` of a Levenberg-Marquardt step; zero for fixed nodes."""
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import splu

    w = graph.inv_sigma
    J_i, J_j = (w[:, :, None] * J for J in jacobians(graph, r))
    count = len(graph.S)
    free = np.ones(count, dtype=bool)
    free[graph.fixed] = False
    row_of = np.where(free, np.cumsum(free) - 1, -1)
    size = 7 * int(free.sum())
    rows = np.repeat(np.arange(7 * len(r)).reshape(-1, 7, 1), 7, axis=2)
    parts = []
    for node, J in ((graph.i, J_i), (graph.j, J_j)):
        kept = free[node]
        columns = np.broadcast_to(7 * row_of[node][:, None, None] + np.arange(7), J.shape)
        parts.append((J[kept].ravel(), rows[kept].ravel(), columns[kept].ravel()))
    values, row, column = (np.concatenate(side) for side in zip(*parts, strict=True))
    J = coo_array((values, (row, column)), shape=(7 * len(r), size)).tocsc()
    H = (J.T @ J).tocsc()
    H = (H + diags_array(damping * H.diagonal())).tocsc()
    step = np.zeros((count, 7))
    step[free] = splu(H).solve(-(J.T @ (w * r).ravel())).reshape(-1, 7)
    return step


def _cost(graph: PoseGraph, r: FloatArray) -> float:
    return float(((graph.inv_sigma * r) ** 2).sum())
