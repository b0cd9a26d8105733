"""Distance of a projected edge pixel from its partner edge, along that edge's normal.

Not in the paper. An edge does not constrain motion along itself, so only the component across it counts; unlike the
cycle, this constrains the pose (REVO, SVO's edgelets).
"""

from typing import TYPE_CHECKING

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

        Arguments and errors are those of `residuals`.
        """
        return self.reduced(self.residuals(T_j_i, uv, depth_i, uv_j, normal_j, K), 1)

    if TYPE_CHECKING:
        __call__ = forward
