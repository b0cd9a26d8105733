"""Distance of a projected edge pixel from its partner edge, along that edge's normal.

Not in the paper. An edge does not constrain motion along itself, so only the component across it counts; unlike the
cycle, this constrains the pose (REVO, SVO's edgelets). All pairs of a window are evaluated at once, with their
derivatives by the *relative* pose (six columns) and the inverse depth (one); the solver maps the former to the two
poses by the adjoint.
"""

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from edgeslam_torch.losses.base import ResidualLoss, Residuals, back_project, lost_of, masked, move, project
from edgeslam_torch.losses.inputs import check_shapes, in_full_precision


class EdgeAlignmentLoss(ResidualLoss):
    """Signed distances [px] of projected edge pixels to their partners, along the partners' normals."""

    @in_full_precision
    def residuals(
        self, T_j_i: Tensor, uv: Tensor, depth_i: Tensor, uv_j: Tensor, normal_j: Tensor, K: Tensor
    ) -> Residuals:
        """Predicted minus observed position across the edge.

        Args:
            T_j_i: Motion from frame i to frame j ``(4, 4)``, in the depths' unit.
            uv: Edge pixels in frame i ``(N, 2)``; NaN for none.
            depth_i: Their z-depths ``(N,)``; 0 where unknown.
            uv_j: The partners in frame j ``(N, 2)``; NaN for an edge without a partner.
            normal_j: The partners' unit normals ``(N, 2)``; zero for an edge without a partner.
            K: Calibration matrix ``(3, 3)`` [px].

        Returns:
            ``(N, 1)`` [px]; invalid behind the camera, without depth or partner. All may have a leading batch axis.

        Raises:
            ValueError: If shapes do not fit.
        """
        check_shapes(
            T_j_i=(T_j_i, "4 4"),
            uv=(uv, "N 2"),
            depth_i=(depth_i, "N"),
            uv_j=(uv_j, "N 2"),
            normal_j=(normal_j, "N 2"),
            K=(K, "? 3 3"),
        )
        observed = torch.cat((uv, uv_j, normal_j), -1).isfinite().all(-1)
        seen = observed & ~(depth_i <= 0) & (normal_j.square().sum(-1) > 0.25)
        uv, uv_j, normal_j = (x.where(seen[..., None], 0.0) for x in (uv, uv_j, normal_j))
        p_j = move(T_j_i, back_project(uv, depth_i.where(seen, 1.0), K))
        predicted, front = project(p_j, K)
        across = ((predicted - uv_j) * normal_j).sum(-1, keepdim=True)
        return masked(across, seen & front, lost_of(seen, K, p_j, predicted))

    @in_full_precision
    def forward(self, T_j_i: Tensor, uv: Tensor, depth_i: Tensor, uv_j: Tensor, normal_j: Tensor, K: Tensor) -> Tensor:
        """Mean (or sum) over edge pixels of squared distances ``()``, ``(B,)`` for a batch of pairs.

        Args:
            T_j_i: Motion from frame i to frame j ``(4, 4)`` or ``(B, 4, 4)``, in the depths' unit.
            uv: Edge pixels in frame i ``(N, 2)`` or ``(B, N, 2)`` [px]; NaN for none.
            depth_i: Their z-depths ``(N,)`` or ``(B, N)``; 0 where unknown.
            uv_j: The partners in frame j, shaped as ``uv`` [px]; NaN for an edge without a partner.
            normal_j: The partners' unit normals, shaped as ``uv``; zero for an edge without a partner.
            K: Calibration matrix ``(3, 3)`` or ``(B, 3, 3)`` [px].

        Raises:
            ValueError: If shapes do not fit.
        """
        return self.reduced(self.residuals(T_j_i, uv, depth_i, uv_j, normal_j, K), 1)

    if TYPE_CHECKING:
        __call__ = forward


class PairGeometry(NamedTuple):
    """Edge pixels seen from their target frames; one element per pair, in any shape ``(...)``."""

    x: Tensor
    """Normalised image coordinate."""
    y: Tensor
    iz: Tensor
    """Inverse z-depth in the target frame."""
    scale: Tensor
    """Depth in the host frame over depth in the target frame."""
    front: Tensor
    """In front of the target camera."""


def pair_geometry(Rt: Tensor, ray: Tensor, inverse_depth: Tensor) -> PairGeometry:
    """Edge pixels in their target frames; trailing axes broadcast.

    Args:
        Rt: Relative motions ``(3, 4, ...)`` from host to target.
        ray: ``(2, ...)`` normalised image coordinates in the host frame.
        inverse_depth: ``(...)`` in the host frame.
    """
    # The point times its inverse depth, so that points at infinity need no special case.
    # Separate products and sums: torch's addcmul is ten times slower if an argument is broadcast along the last axis.
    q = Rt[:, 0] * ray[0] + Rt[:, 1] * ray[1] + Rt[:, 3] * inverse_depth + Rt[:, 2]
    front = q[2] > 1e-6
    scale = torch.where(front, q[2], 1.0).reciprocal()
    return PairGeometry(q[0] * scale, q[1] * scale, inverse_depth * scale, scale, front)


def depth_slopes(g: PairGeometry, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Derivatives of x, y and iz by the inverse depth in the host frame; ``t (3, ...)`` the relative translations."""
    tz = t[2] * g.scale
    return (
        torch.addcmul(t[0] * g.scale, g.x, tz, value=-1.0),
        torch.addcmul(t[1] * g.scale, g.y, tz, value=-1.0),
        torch.addcmul(g.scale, g.iz, tz, value=-1.0),
    )


def partner_line(uv_j: Tensor, normal_j: Tensor, inv_sigma: Tensor, K: Tensor) -> Tensor:
    """Partners as lines ``(3, ...)`` of normalised coordinates: the whitened distance from one is ``a x + b y + c``.

    Args:
        uv_j: Partners ``(2, ...)`` [px].
        normal_j: Their unit normals ``(2, ...)``.
        inv_sigma: Inverse standard deviations ``(...)`` across the edge [1/px].
        K: fx, fy, cx, cy [px], shape ``(4,)``.
    """
    a, b = normal_j[0] * inv_sigma, normal_j[1] * inv_sigma
    return torch.stack((a * K[0], b * K[1], a * (K[2] - uv_j[0]) + b * (K[3] - uv_j[1])))


def alignment_row(g: PairGeometry, line: Tensor) -> Tensor:
    """Whitened distance across the edge ``(...)``; ``line`` from `partner_line`."""
    return torch.addcmul(torch.addcmul(line[2], line[0], g.x), line[1], g.y)


def alignment_jacobians(
    g: PairGeometry, slope: tuple[Tensor, Tensor, Tensor], line: Tensor
) -> tuple[tuple[Tensor, ...], Tensor]:
    """Derivatives of `alignment_row`, linear in ``line``.

    Args:
        g: Pairs in their target frames.
        slope: Their `depth_slopes`.
        line: ``(3, ...)`` from `partner_line`, times any weight.

    Returns:
        By the relative pose's left tangent (six of ``(...)``) and by the inverse depth ``(...)``.
    """
    u, v = line[0], line[1]
    along = torch.addcmul(u * g.x, v, g.y)
    by_pose = (
        u * g.iz,
        v * g.iz,
        -along * g.iz,
        torch.addcmul(-v, along, g.y, value=-1.0),
        torch.addcmul(u, along, g.x),
        torch.addcmul(v * g.x, u, g.y, value=-1.0),
    )
    return by_pose, torch.addcmul(u * slope[0], v, slope[1])


def relative_depth_row(g: PairGeometry, inverse_depth_j: Tensor) -> Tensor:
    """``(z - d_j) / (z + d_j)`` of each pair ``(...)``, by inverse depths."""
    return (inverse_depth_j - g.iz) / (inverse_depth_j + g.iz)


def relative_depth_jacobians(
    g: PairGeometry, slope: tuple[Tensor, Tensor, Tensor], inverse_depth_j: Tensor, weight: Tensor
) -> tuple[tuple[Tensor, ...], Tensor]:
    """Derivatives of `relative_depth_row` times a weight ``(...)``; as `alignment_jacobians` returns them."""
    scale = (inverse_depth_j + g.iz).reciprocal()
    by_iz = inverse_depth_j * scale * scale * (-2.0 * weight)
    k = by_iz * g.iz
    none = torch.zeros_like(k)
    return (none, none, -k * g.iz, -k * g.y, k * g.x, none), by_iz * slope[2]


def round_trip_row(g: PairGeometry, Rt: Tensor, ray: Tensor, inverse_depth_j: Tensor, K: Tensor) -> Tensor:
    """Residual of `round_trip_jacobians` ``(2, ...)`` [px]."""
    back = _way_back(g, Rt, inverse_depth_j)[1]
    front = back[2] > 1e-6
    n = back[:2] / torch.where(front, back[2], 1.0)
    return torch.where(front, (n - ray) * _focal(K, g), 0.0)


def round_trip_jacobians(
    g: PairGeometry,
    slope: tuple[Tensor, Tensor, Tensor],
    Rt: Tensor,
    ray: Tensor,
    inverse_depth_j: Tensor,
    K: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """The paper's pixel cycle, eqs. (17)-(23), with the target's depth held constant, and its derivatives.

    Args:
        g: Pairs in their target frames.
        slope: Their `depth_slopes`.
        Rt: Relative motions ``(3, 4, ...)``.
        ray: ``(2, ...)`` normalised image coordinates in the host frame.
        inverse_depth_j: Inverse depths ``(...)`` that the target frame has at the projected pixel.
        K: fx, fy, cx, cy [px], shape ``(4,)``.

    Returns:
        Residual ``(2, ...)`` [px], derivatives by the relative pose ``(2, 6, ...)`` and the inverse depth ``(2, ...)``.
    """
    R = Rt[:, :3]
    q, back = _way_back(g, Rt, inverse_depth_j)
    front = back[2] > 1e-6
    scale = torch.where(front, back[2], 1.0).reciprocal()
    n = back[:2] * scale
    f = _focal(K, g)
    residual = (n - ray) * f
    # d n / d q: rows of R^T minus n times its last row.
    D = (R[:, :2].transpose(0, 1) - n[:, None] * R[:, 2]) * (scale * f)[:, None]  # (2, 3, ...)
    # The projected pixel moves with the pose: d (x, y) / d xi; and T^-1 moves: -(rho + phi x P'_j).
    Jn = torch.zeros(2, 6, *g.x.shape, dtype=g.x.dtype, device=g.x.device)
    Jn[0, 0], Jn[1, 1] = g.iz, g.iz
    Jn[0, 2], Jn[1, 2] = -g.x * g.iz, -g.y * g.iz
    Jn[0, 3], Jn[0, 4], Jn[0, 5] = -g.x * g.y, 1.0 + g.x * g.x, -g.y
    Jn[1, 3], Jn[1, 4], Jn[1, 5] = -1.0 - g.y * g.y, g.x * g.y, g.x
    J = D[:, 0, None] * Jn[0] + D[:, 1, None] * Jn[1]
    J[:, :3] -= D * inverse_depth_j
    J[:, 3] -= D[:, 2] * q[1] - D[:, 1] * q[2]
    J[:, 4] -= D[:, 0] * q[2] - D[:, 2] * q[0]
    J[:, 5] -= D[:, 1] * q[0] - D[:, 0] * q[1]
    by_depth = D[:, 0] * slope[0] + D[:, 1] * slope[1]
    return torch.where(front, residual, 0.0), torch.where(front, J, 0.0), torch.where(front, by_depth, 0.0)


def _way_back(g: PairGeometry, Rt: Tensor, inverse_depth_j: Tensor) -> tuple[Tensor, Tensor]:
    """Points at the target's depth in the target frame and in the host frame ``(3, ...)``, both scaled by its
    inverse."""
    q = torch.stack((g.x, g.y, torch.ones_like(g.x)))
    return q, (Rt[:, :3] * (q - Rt[:, 3] * inverse_depth_j)[:, None]).sum(0)


def _focal(K: Tensor, g: PairGeometry) -> Tensor:
    return K[:2].reshape(2, *[1] * g.x.ndim)
