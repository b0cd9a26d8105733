"""Edge cycle consistency, paper eqs. (17)-(23)."""

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
)
from edgeslam_torch.losses.inputs import check_shapes, in_full_precision
from edgeslam_torch.losses.robust import Kernel
from edgeslam_torch.losses.sampling import sample


class CycleForm(StrEnum):
    """What the cycle compares."""

    PIXEL = "pixel"
    """Paper eq. (23): the pixel after the round trip against the pixel before it [px]."""
    PARALLAX = "parallax"
    """The same divided by the expected parallax ``f |t| / z``; no unit."""
    RELATIVE_DEPTH = "relative depth"
    """``(z - d_j) / (z + d_j)`` of the depth predicted in frame j; no unit."""


class CycleLoss(ResidualLoss):
    """Round trip of edge pixels from frame i to frame j and back.

    Note:
        The paper's pixel form is exactly zero for a camera that does not move, whatever the depths
        (docs/decisions/08-cycle-loss.md); the relative depth is the default because it does not shrink the baseline.
    """

    def __init__(
        self,
        form: CycleForm = CycleForm.RELATIVE_DEPTH,
        reduction: Reduction = Reduction.MEAN,
        kernel: Kernel = Kernel.L2,
        delta: float = 1.0,
        max_relative: float = 0.15,
        min_parallax_px: float = 1.0,
    ) -> None:
        """Choose the form.

        Args:
            form: What to compare.
            reduction: Sum (the paper's) or mean over valid edges.
            kernel: Robust kernel.
            delta: Where it departs from least squares, in the residual's unit.
            max_relative: ``(z - d_j) / (z + d_j)`` above which the pixel is occluded in frame j. Infinite in the
                paper's form, which masks nothing.
            min_parallax_px: Minimum expected parallax of an edge in the form ``PARALLAX``.
        """
        super().__init__(reduction, kernel, delta)
        self.form, self.max_relative, self.min_parallax_px = CycleForm(form), max_relative, min_parallax_px

    @classmethod
    def literal(cls) -> "CycleLoss":
        """The paper's loss as printed: pixels, summed, without occlusion masks."""
        return cls(CycleForm.PIXEL, Reduction.SUM, max_relative=float("inf"))

    @in_full_precision
    def residuals(self, T_j_i: Tensor, uv: Tensor, depth_i: Tensor, depth_j: Tensor, K: Tensor) -> Residuals:
        """Round-trip residuals of edge pixels.

        Args:
            T_j_i: Motion from frame i to frame j ``(4, 4)``, in the depths' unit.
            uv: Edge pixels in frame i ``(N, 2)``; NaN for none.
            depth_i: Their z-depths ``(N,)``; 0 where unknown.
            depth_j: Depth map of frame j ``(H, W)``, or the depths ``(N,)`` already sampled there; 0, NaN or infinite
                where unknown.
            K: Calibration matrix ``(3, 3)`` [px].

        Returns:
            ``(N, 2)`` pixels or ``(N, 1)`` ratios; invalid outside the image, behind a camera, without depth, or
            occluded in frame j. All may have a leading batch axis.

        Raises:
            ValueError: If shapes do not fit.
        """
        is_map = depth_j.ndim > depth_i.ndim
        check_shapes(
            T_j_i=(T_j_i, "4 4"),
            uv=(uv, "N 2"),
            depth_i=(depth_i, "N"),
            depth_j=(depth_j, "H W" if is_map else "N"),
            K=(K, "? 3 3"),
        )
        seen = uv.isfinite().all(-1) & ~(depth_i <= 0)  # NaN and infinity count: it is a prediction
        uv, depth_i = uv.where(seen[..., None], 0.0), depth_i.where(seen, 1.0)
        p_j = move(T_j_i, back_project(uv, depth_i, K))  # eqs. (17), (18)
        uv_j, front = project(p_j, K)  # eq. (19)
        if is_map:
            d_j, known = sample_depth(depth_j, uv_j)
        else:
            known = _known(depth_j)
            d_j = depth_j.where(known, 0.0)
        lost = lost_of(seen, K, p_j, uv_j)
        valid = seen & front & known
        z = p_j[..., 2]
        relative = (z - d_j) / torch.where(valid, z + d_j, 1.0)
        valid = valid & (relative.detach() < self.max_relative)
        if self.form is CycleForm.RELATIVE_DEPTH:
            return masked(relative[..., None], valid, lost)
        back = back_project(uv_j, d_j, K) - T_j_i[..., None, :3, 3]  # eqs. (20), (21)
        round_trip, front = project(back @ T_j_i[..., :3, :3], K)  # eq. (22)
        residual, valid = round_trip - uv, valid & front  # eq. (23)
        if self.form is CycleForm.PARALLAX:
            parallax = expected_parallax_px(T_j_i, depth_i, K)
            valid = valid & (parallax.detach() > self.min_parallax_px)
            residual = residual / torch.where(valid, parallax, 1.0)[..., None]
        return masked(residual, valid, lost)

    @in_full_precision
    def forward(self, T_j_i: Tensor, uv: Tensor, depth_i: Tensor, depth_j: Tensor, K: Tensor) -> Tensor:
        """Mean (or sum) over edge pixels of the squared residuals ``()``, ``(B,)`` for a batch of pairs.

        Arguments and errors are those of `residuals`.
        """
        return self.reduced(self.residuals(T_j_i, uv, depth_i, depth_j, K), 1)

    if TYPE_CHECKING:
        __call__ = forward


def expected_parallax_px(T_j_i: Tensor, depth_i: Tensor, K: Tensor) -> Tensor:
    """Expected parallax ``f |t| / z`` of points at ``depth_i (..., N)`` [px], ``(..., N)``."""
    baseline = (T_j_i[..., :3, 3].square().sum(-1) + 1e-30).sqrt()
    return (K[..., 0, 0] * baseline)[..., None] / depth_i.clamp_min(1e-6)


def sample_depth(depth: Tensor, uv: Tensor) -> tuple[Tensor, Tensor]:
    """Bilinear depths of a map at pixels, and which pixels lie inside and touch no hole.

    Args:
        depth: ``(H, W)`` or ``(B, H, W)``; 0, negative, NaN or infinite in holes.
        uv: ``(N, 2)`` or ``(B, N, 2)`` [px].

    Returns:
        ``(N,)`` or ``(B, N)`` each.
    """
    H, W = depth.shape[-2:]
    size = torch.tensor((W - 1, H - 1), dtype=uv.dtype, device=uv.device)
    inside = ((uv >= 0) & (uv <= size)).all(-1)
    grid = torch.where(inside[..., None], 2.0 * uv / size - 1.0, 0.0)
    hole = ~_known(depth)
    maps = torch.stack((depth.where(~hole, 0.0), hole.to(depth.dtype)), -3)
    out = sample(maps.reshape(-1, 2, H, W), grid.reshape(-1, 1, grid.shape[-2], 2))
    out = out.reshape(*depth.shape[:-2], 2, -1)
    return out[..., 0, :], inside & (out[..., 1, :] == 0)


def _known(depth: Tensor) -> Tensor:
    return (depth > 0) & depth.isfinite()
