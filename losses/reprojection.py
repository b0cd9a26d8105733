"""Reprojection error of anchors, paper eqs. (15)-(16)."""

from typing import TYPE_CHECKING

from torch import Tensor

from edgeslam_torch.losses.base import ResidualLoss, Residuals, lost_of, masked, move, project
from edgeslam_torch.losses.inputs import check_mask, check_shapes, in_full_precision


class ReprojectionLoss(ResidualLoss):
    """Squared reprojection error over a window, paper eqs. (15)-(16).

    ``Reduction.SUM`` is the paper's literal form; the default mean does not fall when points leave the image.
    """

    @in_full_precision
    def residuals(self, T_c_w: Tensor, p_w: Tensor, uv: Tensor, K: Tensor, mask: Tensor | None = None) -> Residuals:
        """Predicted minus observed pixels.

        Args:
            T_c_w: World-to-camera poses ``(W, 4, 4)``.
            p_w: Anchors ``(N, 3)`` [any unit, that of the poses].
            uv: Observed pixels ``(W, N, 2)``; NaN where not observed.
            K: Calibration matrix ``(3, 3)`` [px].
            mask: Which anchor was seen in which frame ``(W, N)`` bool; all by default.

        Returns:
            ``(W, N, 2)`` [px]; invalid where unseen or behind the camera. All may have a leading batch axis.

        Raises:
            ValueError: If shapes do not fit.
            TypeError: If the mask is not bool.
        """
        check_shapes(T_c_w=(T_c_w, "W 4 4"), p_w=(p_w, "N 3"), uv=(uv, "W N 2"), K=(K, "? 3 3"))
        seen = uv.isfinite().all(-1)
        if mask is not None:
            check_shapes(uv=(uv, "W N 2"), mask=(mask, "W N"))
            check_mask(mask)
            seen = seen & mask
        p_w = p_w.where(seen.any(-2)[..., None], 0.0)  # NaN times a gradient of zero would be NaN
        p_c = move(T_c_w, p_w[..., None, :, :])
        K = K if K.ndim == 2 else K[:, None]
        predicted, front = project(p_c, K)
        lost = lost_of(seen, K, p_c, predicted)
        return masked(predicted - uv.where(seen[..., None], 0.0), seen & front, lost)

    @in_full_precision
    def forward(self, T_c_w: Tensor, p_w: Tensor, uv: Tensor, K: Tensor, mask: Tensor | None = None) -> Tensor:
        """Mean (or sum) over observations of squared pixels ``()``, ``(B,)`` for a batch.

        Arguments and errors are those of `residuals`.
        """
        return self.reduced(self.residuals(T_c_w, p_w, uv, K, mask), 2)

    if TYPE_CHECKING:
        __call__ = forward
