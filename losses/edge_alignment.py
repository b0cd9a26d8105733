"""Distance of a projected edge pixel to the edge it should lie on, along that edge's normal.

Not in the paper. An edge tells nothing about motion along itself, so only the component across it counts; unlike
the cycle, this observes the pose (REVO, SVO's edgelets). All pairs of a window are evaluated at once, with their
derivatives by the *relative* pose (six columns) and the inverse depth (one); the solver maps the former to the two
poses by the adjoint.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from edgeslam_torch.losses.base import ResidualLoss, Residuals, back_project, masked, move, project


class EdgeAlignmentLoss(ResidualLoss):
    """Signed distances [px] of projected edge pixels to their partners, along the partners' normals."""

    def residuals(  # type: ignore[override]
        self, T_j_i: Tensor, uv: Tensor, depth_i: Tensor, uv_j: Tensor, normal_j: Tensor, K: Tensor
    ) -> Residuals:
        """Predicted minus observed position across the edge.

        Args:
            T_j_i: Motion from frame i to frame j ``(4, 4)``.
            uv: Edge pixels in frame i ``(N, 2)``.
            depth_i: Their z-depths ``(N,)``.
            uv_j: The partners in frame j ``(N, 2)``.
            normal_j: The partners' unit normals ``(N, 2)``; zero for an edge without a partner.
            K: Calibration matrix ``(3, 3)`` [px].

        Returns:
            ``(N, 1)`` [px].
        """
        predicted, front = project(move(T_j_i, back_project(uv, depth_i, K)), K)
        valid = front & (depth_i > 0) & (normal_j.square().sum(-1) > 0.25)
        return masked(((predicted - uv_j) * normal_j).sum(-1, keepdim=True), valid)


class PairGeometry(NamedTuple):
    """Edge pixels seen from their target frames; components first, ``P`` pairs."""

    x: Tensor
    """``(P,)`` normalised image coordinate."""
    y: Tensor
    iz: Tensor
    """``(P,)`` inverse z-depth in the target frame."""
    slope: Tensor
    """``(3, P)`` derivatives of x, y, iz by the inverse depth in the host frame."""
    front: Tensor
    """``(P,)`` in front of the target camera."""


def pair_geometry(Rt: Tensor, ray: Tensor, inverse_depth: Tensor) -> PairGeometry:
    """Edge pixels in their target frames.

    Args:
        Rt: Each pair's relative motion ``(3, 4, P)`` from host to target.
        ray: ``(2, P)`` normalised image coordinates in the host frame.
        inverse_depth: ``(P,)`` in the host frame.
    """
    # The point times its inverse depth: no division by it, so infinity is an ordinary value.
    q = torch.addcmul(torch.addcmul(Rt[:, 2], Rt[:, 0], ray[0]), Rt[:, 1], ray[1])
    q = torch.addcmul(q, Rt[:, 3], inverse_depth)
    front = q[2] > 1e-6
    scale = torch.where(front, q[2], 1.0).reciprocal()
    n = q[:2] * scale
    iz = inverse_depth * scale
    t_scaled = Rt[:, 3] * scale
    across = torch.addcmul(t_scaled[:2], n, t_scaled[2], value=-1.0)
    slope = torch.cat((across, torch.addcmul(scale, iz, t_scaled[2], value=-1.0)[None]))
    return PairGeometry(n[0], n[1], iz, slope, front)


def alignment_row(g: PairGeometry, uv_j: Tensor, normal_j: Tensor, K: Tensor) -> Tensor:
    """Distance across the edge ``(P,)`` [px]; arguments as `alignment_jacobians` takes them."""
    a = normal_j * K[:2, None]
    return torch.addcmul(a[0] * g.x, a[1], g.y) + ((K[2:, None] - uv_j) * normal_j).sum(0)


def alignment_jacobians(g: PairGeometry, uv_j: Tensor, normal_j: Tensor, K: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distance across the edge with derivatives.

    Args:
        g: Pairs in their target frames.
        uv_j: Partners ``(2, P)`` [px].
        normal_j: Their unit normals ``(2, P)``.
        K: fx, fy, cx, cy [px], shape ``(4,)``.

    Returns:
        Residual ``(P,)``, its derivatives by the relative pose's left tangent ``(6, P)`` and inverse depth ``(P,)``.
    """
    a = normal_j * K[:2, None]
    u, v = a[0], a[1]
    along = torch.addcmul(u * g.x, v, g.y)
    J = torch.empty(6, g.x.shape[0], dtype=g.x.dtype, device=g.x.device)
    torch.mul(a, g.iz, out=J[:2])
    torch.mul(along, g.iz, out=J[2]).neg_()
    torch.addcmul(-v, along, g.y, value=-1.0, out=J[3])
    torch.addcmul(u, along, g.x, out=J[4])
    torch.addcmul(v * g.x, u, g.y, value=-1.0, out=J[5])
    residual = along + ((K[2:, None] - uv_j) * normal_j).sum(0)
    return residual, J, torch.addcmul(u * g.slope[0], v, g.slope[1])


def relative_depth_row(g: PairGeometry, inverse_depth_j: Tensor) -> Tensor:
    """``(z - d_j) / (z + d_j)`` of each pair ``(P,)``, by inverse depths."""
    return (inverse_depth_j - g.iz) / (inverse_depth_j + g.iz)


def relative_depth_jacobians(g: PairGeometry, inverse_depth_j: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """`relative_depth_row` with its derivatives by the relative pose ``(6, P)`` and the inverse depth ``(P,)``."""
    scale = (inverse_depth_j + g.iz).reciprocal()
    residual = (inverse_depth_j - g.iz) * scale
    by_iz = -2.0 * inverse_depth_j * scale * scale
    J = torch.zeros(6, g.x.shape[0], dtype=g.x.dtype, device=g.x.device)
    k = by_iz * g.iz
    torch.mul(k, g.iz, out=J[2]).neg_()
    torch.mul(k, g.y, out=J[3]).neg_()
    torch.mul(k, g.x, out=J[4])
    return residual, J, by_iz * g.slope[2]


def round_trip_jacobians(
    g: PairGeometry, Rt: Tensor, ray: Tensor, inverse_depth_j: Tensor, K: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """The paper's pixel cycle, eqs. (17)-(23), with the target's depth held, and its derivatives.

    Args:
        g: Pairs in their target frames.
        Rt: Relative motions ``(3, 4, P)``.
        ray: ``(2, P)`` normalised image coordinates in the host frame.
        inverse_depth_j: Inverse depths ``(P,)`` that the target frame has at the projected pixel.
        K: fx, fy, cx, cy [px], shape ``(4,)``.

    Returns:
        Residual ``(2, P)`` [px], derivatives by the relative pose ``(2, 6, P)`` and the inverse depth ``(2, P)``.
    """
    R, t = Rt[:, :3], Rt[:, 3]
    # Times the target's inverse depth, for the same reason as above.
    q = torch.stack((g.x, g.y, torch.ones_like(g.x)))
    back = (R * (q - t * inverse_depth_j)[:, None]).sum(0)
    front = back[2] > 1e-6
    scale = torch.where(front, back[2], 1.0).reciprocal()
    n = back[:2] * scale
    residual = (n - ray) * K[:2, None]
    # d n / d q: rows of R^T minus n times its last row.
    D = (R[:, :2].transpose(0, 1) - n[:, None] * R[:, 2]) * (scale * K[:2, None])[:, None]  # (2, 3, P)
    # The projected pixel moves with the pose: d (x, y) / d xi; and T^-1 moves: -(rho + phi x P'_j).
    Jn = torch.zeros(2, 6, g.x.shape[0], dtype=g.x.dtype, device=g.x.device)
    Jn[0, 0], Jn[1, 1] = g.iz, g.iz
    Jn[0, 2], Jn[1, 2] = -g.x * g.iz, -g.y * g.iz
    Jn[0, 3], Jn[0, 4], Jn[0, 5] = -g.x * g.y, 1.0 + g.x * g.x, -g.y
    Jn[1, 3], Jn[1, 4], Jn[1, 5] = -1.0 - g.y * g.y, g.x * g.y, g.x
    J = D[:, 0, None] * Jn[0] + D[:, 1, None] * Jn[1]
    J[:, :3] -= D * inverse_depth_j
    J[:, 3] -= D[:, 2] * q[1] - D[:, 1] * q[2]
    J[:, 4] -= D[:, 0] * q[2] - D[:, 2] * q[0]
    J[:, 5] -= D[:, 1] * q[0] - D[:, 0] * q[1]
    by_depth = D[:, 0] * g.slope[0] + D[:, 1] * g.slope[1]
    return torch.where(front, residual, 0.0), torch.where(front, J, 0.0), torch.where(front, by_depth, 0.0)
