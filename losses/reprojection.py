"""Reprojection error of anchors, paper eqs. (15)-(16)."""

from torch import Tensor

from edgeslam_torch.losses.base import ResidualLoss, Residuals, masked, move, project


class ReprojectionLoss(ResidualLoss):
    """Squared reprojection error over a window, paper eqs. (15)-(16).

    ``Reduction.SUM`` is the paper's literal form; the default mean does not fall when points leave the image.
    """

    def residuals(  # type: ignore[override]
        self, T_c_w: Tensor, p_w: Tensor, uv: Tensor, K: Tensor, mask: Tensor | None = None
    ) -> Residuals:
        """Predicted minus observed pixels.

        Args:
            T_c_w: World-to-camera poses ``(W, 4, 4)``.
            p_w: Anchors ``(N, 3)``.
            uv: Observed pixels ``(W, N, 2)``.
            K: Calibration matrix ``(3, 3)`` [px].
            mask: Which anchor was seen in which frame ``(W, N)``; all by default.

        Returns:
            ``(W, N, 2)`` [px]; invalid where unseen or behind the camera.
        """
        predicted, valid = project(move(T_c_w, p_w), K)
        return masked(predicted - uv, valid if mask is None else valid & mask)


def camera_points(T_c_w: Tensor, p_w: Tensor, obs_pose: Tensor, obs_anchor: Tensor) -> tuple[Tensor, Tensor]:
    """Each observation's rotation ``(3, 3, M)`` and point in its camera ``(3, M)``.

    Args:
        T_c_w: World-to-camera poses ``(W, 4, 4)``.
        p_w: Anchors ``(A, 3)``.
        obs_pose: ``(M,)`` pose indices.
        obs_anchor: ``(M,)`` anchor indices.
    """
    Rt = T_c_w[:, :3, :].permute(1, 2, 0).reshape(12, -1).index_select(1, obs_pose).view(3, 4, -1)
    p = p_w.mT.contiguous().index_select(1, obs_anchor)
    R = Rt[:, :3]
    return R, (R * p).sum(1) + Rt[:, 3]


def reprojection_residuals(p_c: Tensor, uv: Tensor, K: Tensor) -> Tensor:
    """Predicted minus observed pixels ``(2, M)``, paper eqs. (15)-(16).

    Args:
        p_c: Points in the cameras that see them ``(3, M)``, from `camera_points`.
        uv: Observed undistorted pixels ``(2, M)``.
        K: fx, fy, cx, cy [px], shape ``(4,)``.
    """
    return p_c[:2] / p_c[2] * K[:2, None] + (K[2:, None] - uv)
