"""L-shape consistency: the angle and the straightness of the arms of corners, paper eqs. (24)-(27)."""

from enum import StrEnum

import torch
from torch import Tensor

from edgeslam_torch.losses.base import (
    Reduction,
    ResidualLoss,
    Residuals,
    back_project,
    masked,
    move,
    project,
    reduce,
)
from edgeslam_torch.losses.edge_alignment import pair_geometry
from edgeslam_torch.losses.robust import Kernel


class AngleForm(StrEnum):
    """Which angle is expected to equal which."""

    CROSS_VIEW = "cross view"
    """Arms of frame i projected into frame j against the angle seen there."""
    SAME_FRAME = "same frame"
    """Paper eqs. (24), (25) to the letter: back-projected and projected into the same frame; identically zero."""
    RIGHT_ANGLE = "right angle"
    """The arms' angle in space against 90 degrees, only where it is nearly that."""


class AngleLoss(ResidualLoss):
    """Difference of cosines between the projected and the expected angle of each L-junction.

    Note:
        The cosine is computed directly; the paper's cos(arccos(.)) has an infinite derivative at straight angles
        (docs/decisions.md, "L-shape").
    """

    def __init__(
        self,
        form: AngleForm = AngleForm.CROSS_VIEW,
        reduction: Reduction = Reduction.MEAN,
        kernel: Kernel = Kernel.L2,
        delta: float = 1.0,
        gate_cos: float = 0.26,
    ) -> None:
        """Choose the form; ``gate_cos`` is the |cosine| (15 degrees off square) up to which a corner may be square."""
        super().__init__(reduction, kernel, delta)
        self.form, self.gate_cos = AngleForm(form), gate_cos

    def residuals(  # type: ignore[override]
        self, T_j_i: Tensor, uv: Tensor, depth_i: Tensor, cos_j: Tensor, K: Tensor
    ) -> Residuals:
        """Cosine of the projected angle minus the expected cosine.

        Args:
            T_j_i: Motion from frame i to frame j ``(4, 4)``.
            uv: Corner, end of arm 1, end of arm 2 in frame i ``(C, 3, 2)`` [px].
            depth_i: Their z-depths ``(C, 3)``.
            cos_j: Cosine of the angle that frame j sees ``(C,)``; NaN where it sees none. Not used by
                ``SAME_FRAME`` and ``RIGHT_ANGLE``.
            K: Calibration matrix ``(3, 3)`` [px].

        Returns:
            ``(C, 1)``.
        """
        p_i = back_project(uv, depth_i, K)
        positive = (depth_i > 0).all(-1)
        if self.form is AngleForm.RIGHT_ANGLE:
            cos, proper = cosine(p_i[:, 1] - p_i[:, 0], p_i[:, 2] - p_i[:, 0])
            return masked(cos[:, None], positive & proper & (cos.detach().abs() < self.gate_cos))
        same = self.form is AngleForm.SAME_FRAME
        projected, front = project(p_i if same else move(T_j_i, p_i), K)
        cos, proper = cosine(projected[:, 1] - projected[:, 0], projected[:, 2] - projected[:, 0])
        expected = cosine(uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0])[0] if same else cos_j
        valid = positive & front.all(-1) & proper & expected.isfinite()
        return masked((cos - torch.where(valid, expected, 0.0))[:, None], valid)


def cosine(a: Tensor, b: Tensor, min_length: float = 1e-6) -> tuple[Tensor, Tensor]:
    """Cosine ``(...)`` of the angle between ``(..., D)`` vectors, paper eq. (25); and where it is defined."""
    squared = a.square().sum(-1) * b.square().sum(-1)
    proper = squared > min_length**4
    return (a * b).sum(-1) * torch.where(proper, squared, 1.0).rsqrt(), proper


class CollinearityLoss(ResidualLoss):
    """Perpendicular offsets of edge points from the best-fit 3-D line of their arm, paper eq. (26).

    Note:
        Offsets are divided by the arm's length unless ``literal``: in metres they vanish with the depth
        (docs/decisions.md, "L-shape"). The line is a constant for the gradient; at the best fit its own
        derivative drops out.
    """

    def __init__(
        self,
        literal: bool = False,
        reduction: Reduction = Reduction.MEAN,
        kernel: Kernel = Kernel.L2,
        delta: float = 1.0,
    ) -> None:
        """Choose ``literal`` for the paper's metres."""
        super().__init__(reduction, kernel, delta)
        self.literal = literal

    def residuals(self, p: Tensor, mask: Tensor | None = None) -> Residuals:  # type: ignore[override]
        """Offsets of points from their arms' lines.

        Args:
            p: Points of each arm ``(C, 2, M, 3)`` [m].
            mask: Which points exist ``(C, 2, M)``; all by default.

        Returns:
            ``(C, 2, M, 3)`` offset vectors over the root of the arm's number of points, so that the squares of an
            arm add up to its mean; invalid for arms of fewer than 3 points.
        """
        given = torch.ones(p.shape[:-1], dtype=torch.bool, device=p.device) if mask is None else mask
        weight = given.to(p.dtype)[..., None]
        count = weight.sum(-2, keepdim=True)
        centre = (p * weight).sum(-2, keepdim=True) / count.clamp_min(1)
        with torch.no_grad():
            offset = (p - centre) * weight
            direction = torch.linalg.eigh(offset.mT @ offset)[1][..., -1:]  # (C, 2, 3, 1)
            along = (offset @ direction)[..., 0]
            length = along.amax(-1) - along.amin(-1)
            valid = given & (count[..., 0] >= 3) & (length > 1e-9)[..., None]
            divisor = count.sqrt() if self.literal else count.sqrt() * length[..., None, None].clamp_min(1e-9)
        centred = p - centre
        across = centred - (centred @ direction) * direction.mT
        return masked(across / divisor.clamp_min(1e-9), valid)

    def forward(self, p: Tensor, mask: Tensor | None = None) -> Tensor:  # type: ignore[override]
        """Mean (or sum) over corners of both arms' mean squared offsets ``()``; arguments as `residuals`."""
        residuals = self.residuals(p, mask)
        total = reduce(residuals, Reduction.SUM, self.kernel, self.delta)
        if self.reduction is Reduction.SUM:
            return total
        return total / residuals.valid.flatten(1).any(1).sum().clamp_min(1)


class LShapeLoss(torch.nn.Module):
    """``lambda_theta L_angle + lambda_col L_colinear``, paper eq. (27)."""

    def __init__(
        self, angle: AngleLoss, collinearity: CollinearityLoss, lambda_theta: float = 1.0, lambda_col: float = 1.0
    ) -> None:
        """Combine the two terms."""
        super().__init__()
        self.angle, self.collinearity = angle, collinearity
        self.lambda_theta, self.lambda_col = lambda_theta, lambda_col

    @classmethod
    def literal(cls, lambda_theta: float = 1.0, lambda_col: float = 1.0) -> "LShapeLoss":
        """The paper's terms to the letter."""
        return cls(AngleLoss(AngleForm.SAME_FRAME), CollinearityLoss(literal=True), lambda_theta, lambda_col)

    def forward(
        self,
        T_j_i: Tensor,
        uv: Tensor,
        depth_i: Tensor,
        cos_j: Tensor,
        K: Tensor,
        arms: Tensor,
        arms_mask: Tensor | None = None,
    ) -> Tensor:
        """Weighted sum ``()``; arguments as the two terms take them, ``arms`` being the collinearity's points."""
        angle = self.angle(T_j_i, uv, depth_i, cos_j, K)
        return self.lambda_theta * angle + self.lambda_col * self.collinearity(arms, arms_mask)


def junction_rows(
    Rt: Tensor, rays: Tensor, inverse_depth: Tensor, uv_j: Tensor, arms_j: Tensor, K: Tensor, cosines: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Residuals of L-junctions seen from their target frames, with derivatives; ``Q`` pairs.

    Args:
        Rt: Each pair's relative motion ``(3, 4, Q)`` from host to target.
        rays: Normalised coordinates ``(3, 2, Q)`` of corner and arm ends in the host frame.
        inverse_depth: Their inverse depths ``(3, Q)`` there.
        uv_j: Corner that the target sees ``(2, Q)`` [px].
        arms_j: Unit directions of the arms that the target sees ``(2, 2, Q)``, arm first.
        K: fx, fy, cx, cy [px], shape ``(4,)``.
        cosines: One row, the angle's cosine (paper eq. 24 across views), in place of two, the sines of the angles
            between each projected arm and the one seen.

    Returns:
        Residuals ``(R, Q)``: corner u and v [px], then one or two angle rows; derivatives by the relative pose
        ``(R, 6, Q)`` and by the inverse depths ``(R, 3, Q)``; and which pairs lie in front ``(Q,)``.
    """
    points = [pair_geometry(Rt, rays[k], inverse_depth[k]) for k in range(3)]
    f = K[:2, None]
    uv = [torch.stack((g.x, g.y)) * f for g in points]
    by_pose = [_point_jacobian(g.x, g.y, g.iz) * f[:, None] for g in points]
    by_depth = [g.slope[:2] * f for g in points]
    Q = uv_j.shape[1]
    R = 3 if cosines else 4
    r, J, Jd = uv_j.new_zeros(R, Q), uv_j.new_zeros(R, 6, Q), uv_j.new_zeros(R, 3, Q)
    r[:2] = uv[0] + (K[2:, None] - uv_j)
    J[:2], Jd[:2, 0] = by_pose[0], by_depth[0]
    arm = [uv[1] - uv[0], uv[2] - uv[0]]
    length = [a.square().sum(0).clamp_min(1e-12).sqrt() for a in arm]
    unit = [a / n for a, n in zip(arm, length, strict=True)]
    if cosines:
        cos = (unit[0] * unit[1]).sum(0)
        r[2] = cos - (arms_j[0] * arms_j[1]).sum(0)
        slopes = [(2, 0, (unit[1] - cos * unit[0]) / length[0]), (2, 1, (unit[0] - cos * unit[1]) / length[1])]
    else:
        slopes = []
        for k in range(2):
            d, u = arms_j[k], unit[k]
            r[2 + k] = d[0] * u[1] - d[1] * u[0]
            across = torch.stack((-d[1], d[0]))
            slopes.append((2 + k, k, (across - r[2 + k] * u) / length[k]))
    for row, k, w in slopes:
        J[row] += (w[:, None] * (by_pose[k + 1] - by_pose[0])).sum(0)
        Jd[row, 0] -= (w * by_depth[0]).sum(0)
        Jd[row, k + 1] += (w * by_depth[k + 1]).sum(0)
    front = points[0].front & points[1].front & points[2].front
    return r, J, Jd, front


def _point_jacobian(x: Tensor, y: Tensor, iz: Tensor) -> Tensor:
    """Normalised coordinates by the left tangent of the pose, ``(2, 6, Q)``."""
    o = torch.zeros_like(x)
    rows = (iz, o, -x * iz, -x * y, 1.0 + x * x, -y, o, iz, -y * iz, -1.0 - y * y, x * y, x)
    return torch.stack(rows).view(2, 6, -1)
