"""L-shape consistency: the angle and the straightness of the arms of corners, paper eqs. (24)-(27)."""

from enum import StrEnum
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from edgeslam_torch.losses.base import (
    Reduction,
    ResidualLoss,
    Residuals,
    back_project,
    lost_of,
    masked,
    move,
    project,
    reduce,
)
from edgeslam_torch.losses.inputs import check_mask, check_shapes, in_full_precision
from edgeslam_torch.losses.robust import Kernel


class AngleForm(StrEnum):
    """Which two angles are compared."""

    CROSS_VIEW = "cross view"
    """Arms of frame i projected into frame j against the angle seen there."""
    SAME_FRAME = "same frame"
    """Paper eqs. (24), (25) as printed: back-projected and projected into the same frame; identically zero."""
    RIGHT_ANGLE = "right angle"
    """The arms' 3-D angle against 90 degrees, only where it is nearly right."""


class AngleLoss(ResidualLoss):
    """Difference of cosines between the projected and the expected angle of each L-junction.

    Note:
        The cosine is computed directly; the paper's cos(arccos(.)) has an infinite derivative at straight angles
        (docs/decisions/09-l-shape-loss.md).
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

    @in_full_precision
    def residuals(self, T_j_i: Tensor, uv: Tensor, depth_i: Tensor, cos_j: Tensor, K: Tensor) -> Residuals:
        """Cosine of the projected angle minus the expected cosine.

        Args:
            T_j_i: Motion from frame i to frame j ``(4, 4)``, in the depths' unit.
            uv: Corner, end of arm 1, end of arm 2 in frame i ``(C, 3, 2)`` [px]; NaN for none.
            depth_i: Their z-depths ``(C, 3)``; 0 where unknown.
            cos_j: Cosine of the angle observed in frame j ``(C,)``; NaN if not observed. Not used by
                ``SAME_FRAME`` and ``RIGHT_ANGLE``.
            K: Calibration matrix ``(3, 3)`` [px].

        Returns:
            ``(C, 1)``; all may have a leading batch axis.

        Raises:
            ValueError: If shapes do not fit.
        """
        check_shapes(
            T_j_i=(T_j_i, "4 4"), uv=(uv, "C 3 2"), depth_i=(depth_i, "C 3"), cos_j=(cos_j, "C"), K=(K, "? 3 3")
        )
        seen = uv.isfinite().all((-1, -2)) & ~(depth_i <= 0).any(-1)
        if self.form is AngleForm.CROSS_VIEW:
            seen = seen & cos_j.isfinite()
            cos_j = cos_j.where(seen, 0.0)
        uv, depth_i = uv.where(seen[..., None, None], 0.0), depth_i.where(seen[..., None], 1.0)
        p = back_project(uv.flatten(-3, -2), depth_i.flatten(-2), K)  # (..., 3 C, 3)
        if self.form is AngleForm.CROSS_VIEW:
            p = move(T_j_i, p)
        lost = lost_of(seen, K, p.unflatten(-2, (-1, 3)).flatten(-2))
        if self.form is AngleForm.RIGHT_ANGLE:
            cos, proper = _cosine_of_arms(p.unflatten(-2, (-1, 3)))
            return masked(cos[..., None], seen & proper & (cos.detach().abs() < self.gate_cos), lost)
        projected, front = project(p, K)
        cos, proper = _cosine_of_arms(projected.unflatten(-2, (-1, 3)))
        expected = cos_j if self.form is AngleForm.CROSS_VIEW else _cosine_of_arms(uv)[0]
        valid = seen & front.unflatten(-1, (-1, 3)).all(-1) & proper
        return masked((cos - expected)[..., None], valid, lost)

    @in_full_precision
    def forward(self, T_j_i: Tensor, uv: Tensor, depth_i: Tensor, cos_j: Tensor, K: Tensor) -> Tensor:
        """Mean (or sum) over corners of squared differences of cosines ``()``, ``(B,)`` for a batch of pairs.

        Arguments and errors are those of `residuals`.
        """
        return self.reduced(self.residuals(T_j_i, uv, depth_i, cos_j, K), 1)

    if TYPE_CHECKING:
        __call__ = forward


def cosine(a: Tensor, b: Tensor, min_length: float = 1e-6) -> tuple[Tensor, Tensor]:
    """Cosine ``(...)`` of the angle between ``(..., D)`` vectors, paper eq. (25); and where it is defined."""
    squared = a.square().sum(-1) * b.square().sum(-1)
    proper = squared > min_length**4
    return (a * b).sum(-1) * torch.where(proper, squared, 1.0).rsqrt(), proper


def _cosine_of_arms(points: Tensor) -> tuple[Tensor, Tensor]:
    """`cosine` between the arms of corners ``(..., 3, D)``."""
    return cosine(points[..., 1, :] - points[..., 0, :], points[..., 2, :] - points[..., 0, :])


class CollinearityLoss(ResidualLoss):
    """Perpendicular offsets of edge points from the best-fit 3-D line of their arm, paper eq. (26).

    Note:
        Offsets are divided by the arm's length unless ``literal``: in metres they shrink with the depth
        (docs/decisions/09-l-shape-loss.md). The line's direction is a constant for the gradient; at the best fit its
        own derivative drops out. The length is not held constant, otherwise the gradient would be the metric error's.
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

    @in_full_precision
    def residuals(self, p: Tensor, mask: Tensor | None = None) -> Residuals:
        """Offsets of points from their arms' lines.

        Args:
            p: Points of each arm ``(C, 2, M, 3)`` [m].
            mask: Which points exist ``(C, 2, M)`` bool; all by default.

        Returns:
            ``(C, 2, M, 3)`` offset vectors over the root of the arm's number of points, so that the squares of an
            arm add up to its mean; invalid for arms of fewer than 3 points. All may have a leading batch axis.

        Raises:
            ValueError: If shapes do not fit.
            TypeError: If the mask is not bool.
        """
        check_shapes(p=(p, "C 2 M 3"))
        if mask is not None:
            check_shapes(p=(p, "C 2 M 3"), mask=(mask, "C 2 M"))
            check_mask(mask)
        given = torch.ones(p.shape[:-1], dtype=torch.bool, device=p.device) if mask is None else mask
        lost = given & ~p.isfinite().all(-1)
        p = p.where((given & ~lost)[..., None], 0.0)
        weight = given.to(p.dtype)[..., None]
        count = weight.sum(-2, keepdim=True)
        centre = (p * weight).sum(-2, keepdim=True) / count.clamp_min(1)
        with torch.no_grad():
            offset = (p - centre) * weight
            direction = torch.linalg.eigh(offset.mT @ offset)[1][..., -1:]  # (C, 2, 3, 1)
        centred = p - centre
        along = centred @ direction
        # Of points at even distances it is the distance of the ends; unlike that it does not turn with the line.
        spread = 12.0 * (count - 1) / (count + 1) * (along * weight).square().sum(-2, keepdim=True) / count.clamp_min(1)
        valid = given & (count[..., 0] >= 3) & (spread[..., 0] > 1e-18)
        divisor = count.clamp_min(1)
        if not self.literal:
            divisor = divisor * torch.where(valid.any(-1)[..., None, None], spread, 1.0)
        return masked((centred - along * direction.mT) / divisor.sqrt(), valid, lost)

    @in_full_precision
    def forward(self, p: Tensor, mask: Tensor | None = None) -> Tensor:
        """Mean (or sum) over corners of both arms' mean squared offsets ``()``, ``(B,)`` for a batch.

        Arguments and errors are those of `residuals`.
        """
        residuals = self.residuals(p, mask)
        total = reduce(residuals, Reduction.SUM, self.kernel, self.delta, axes=3)
        if self.reduction is Reduction.SUM:
            return total
        return total / residuals.valid.flatten(-2).any(-1).sum(-1).clamp_min(1)

    if TYPE_CHECKING:
        __call__ = forward


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
        """The paper's terms as printed."""
        return cls(AngleLoss(AngleForm.SAME_FRAME), CollinearityLoss(literal=True), lambda_theta, lambda_col)

    @in_full_precision
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
        """Weighted sum of the two terms ``()``, ``(B,)`` for a batch of pairs.

        Args:
            T_j_i: Motion from frame i to frame j ``(4, 4)`` or ``(B, 4, 4)``, in the depths' unit.
            uv: Corner, end of arm 1, end of arm 2 in frame i ``(C, 3, 2)`` or ``(B, C, 3, 2)`` [px]; NaN for none.
            depth_i: Their z-depths ``(C, 3)`` or ``(B, C, 3)``; 0 where unknown.
            cos_j: Cosine of the angle observed in frame j ``(C,)`` or ``(B, C)``; NaN if not observed.
            K: Calibration matrix ``(3, 3)`` or ``(B, 3, 3)`` [px].
            arms: Points of straight arms ``(A, 2, M, 3)`` or ``(B, A, 2, M, 3)`` [m], of these corners or others.
            arms_mask: Which of them exist ``(A, 2, M)`` or ``(B, A, 2, M)``, bool; all by default.

        Raises:
            ValueError: If shapes do not fit.
            TypeError: If the mask is not bool.
        """
        check_shapes(T_j_i=(T_j_i, "4 4"), arms=(arms, "A 2 M 3"))  # one batch
        angle = self.angle(T_j_i, uv, depth_i, cos_j, K)
        return self.lambda_theta * angle + self.lambda_col * self.collinearity(arms, arms_mask)

    if TYPE_CHECKING:
        __call__ = forward


def junction_residuals(
    Rt: Tensor, rays: Tensor, inverse_depth: Tensor, uv_j: Tensor, arms_j: Tensor, K: Tensor, cosines: bool
) -> tuple[Tensor, Tensor]:
    """Residuals of L-junctions seen from their target frames; trailing axes broadcast.

    Args:
        Rt: Relative motions ``(3, 4, ...)`` from host to target.
        rays: Normalised coordinates ``(2, 3, ...)`` of corner and arm ends in the host frame.
        inverse_depth: Their inverse depths ``(3, ...)`` there.
        uv_j: Corner observed in the target ``(2, ...)`` [px].
        arms_j: Unit directions of the arms observed in the target ``(2, 2, ...)``, coordinate first, then arm.
        K: fx, fy, cx, cy [px], shape ``(4,)``.
        cosines: One row, the angle's cosine (paper eq. 24 across views), instead of two, the sines of the angles
            between projected and observed arms.

    Returns:
        Residuals ``(R, ...)``: corner u and v [px], then one or two angle rows; and which pairs lie in front ``(...)``.
    """
    # The point times its inverse depth, so that points at infinity need no special case.
    R, t = Rt[:, :3, None], Rt[:, 3, None]
    q = R[:, 0] * rays[0] + R[:, 1] * rays[1] + R[:, 2] + t * inverse_depth
    front = q[2] > 1e-6
    f, c = (k.reshape(2, *[1] * front.ndim) for k in (K[:2], K[2:]))
    uv = q[:2] / torch.where(front, q[2], 1.0) * f + c
    unit = _arms(uv)
    rows = _cosine(unit) - _cosine(arms_j) if cosines else _sines(arms_j, unit)
    return torch.cat((uv[:, 0] - uv_j, rows)), front.all(0)


def _arms(uv: Tensor) -> Tensor:
    """Unit directions ``(2, 2, ...)`` of both arms, coordinate first."""
    arm = uv[:, 1:] - uv[:, :1]
    return arm / arm.square().sum(0).clamp_min(1e-12).sqrt()


def _cosine(unit: Tensor) -> Tensor:
    return (unit[:, 0] * unit[:, 1]).sum(0, keepdim=True)


def _sines(seen: Tensor, unit: Tensor) -> Tensor:
    return seen[0] * unit[1] - seen[1] * unit[0]
