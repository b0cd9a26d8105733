"""Reprojection error of anchors, paper eqs. (15)-(16)."""

from typing import NamedTuple

import torch
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


class ReprojectionJacobians(NamedTuple):
    """Residuals with their derivatives, components first so that every row is one contiguous vector.

    Columns of points that are not in front of the camera hold no meaning.
    """

    residual: Tensor
    """``(2, M)`` predicted minus observed [px]."""
    pose: Tensor
    """``(2, 6, M)`` by the left tangent ``(rho, phi)`` of ``T_c_w``."""
    point: Tensor
    """``(2, 3, M)`` by the anchor in the world."""


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


def reprojection_jacobians(R: Tensor, p_c: Tensor, uv: Tensor, K: Tensor) -> ReprojectionJacobians:
    """`reprojection_residuals` with derivatives written out; ``R (3, 3, M)`` and ``p_c`` from `camera_points`."""
    z = p_c[2]
    iz = z.reciprocal()
    n = p_c[:2] * iz  # (2, M) normalised image coordinates
    x, y = n
    residual = n * K[:2, None] + (K[2:, None] - uv)
    f_iz = K[:2, None] * iz
    point = f_iz[:, None] * (R[:2] - n[:, None] * R[2])
    none, fx, fy = torch.zeros_like(z), K[0], K[1]
    xy, fx_iz, fy_iz = x * y, f_iz[0], f_iz[1]
    u = (fx_iz, none, -fx_iz * x, -fx * xy, fx * (x * x + 1.0), -fx * y)
    v = (none, fy_iz, -fy_iz * y, -fy * (y * y + 1.0), fy * xy, fy * x)
    pose = torch.stack((*u, *v)).view(2, 6, -1)
    return ReprojectionJacobians(residual, pose, point)


def inverse_depth_jacobians(R: Tensor, p_c: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Inverse z-depth of points and its derivatives, for the depth network's prior on anchors.

    Args:
        R: Rotations ``(3, 3, D)`` of the host poses (world to camera).
        p_c: Points in the host cameras ``(3, D)``.

    Returns:
        ``1 / z`` ``(D,)``, its derivatives by the pose's left tangent ``(6, D)`` and the anchor ``(3, D)``.
    """
    iz = p_c[2].reciprocal()
    m = -iz * iz
    zero = torch.zeros_like(iz)
    pose = torch.stack((zero, zero, m, m * p_c[1], -m * p_c[0], zero))
    return iz, pose, m * R[2]
