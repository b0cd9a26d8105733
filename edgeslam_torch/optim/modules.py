"""Residuals of a window by the modules of `losses`, their derivatives by automatic differentiation.

The reference of `optim.kernels`: short, differentiable, on a GPU if there is one, and many times slower. Selected by
``window.solver = "modules"``; the functions have the signatures of `optim.kernels.rows`.
"""

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgeslam_torch.geometry import se3_torch as lie
from edgeslam_torch.losses.base import Residuals, move
from edgeslam_torch.losses.cycle import CycleForm, CycleLoss
from edgeslam_torch.losses.edge_alignment import EdgeAlignmentLoss
from edgeslam_torch.losses.lshape import junction_residuals
from edgeslam_torch.losses.reprojection import ReprojectionLoss
from edgeslam_torch.optim.kernels.edges import PIXEL, RELATIVE_DEPTH
from edgeslam_torch.types import FloatArray, IntArray

Rows = tuple[FloatArray, FloatArray, NDArray[np.bool_]]
Intrinsics = tuple[float, float, float, float]
_FORMS = {RELATIVE_DEPTH: CycleForm.RELATIVE_DEPTH, PIXEL: CycleForm.PIXEL}


def reprojection(
    T_c_w: FloatArray,
    p_w: FloatArray,
    pose: IntArray,
    anchor: IntArray,
    uv: FloatArray,
    inv_sigma: FloatArray,
    K: Intrinsics,
) -> Rows:
    """Observations, each a window of one pose and one anchor."""
    T, p, seen, camera = _tensor(T_c_w[pose]), _tensor(p_w[anchor]), _tensor(uv), _matrix(K)

    def residuals(xi: Tensor, dp: Tensor) -> Residuals:
        value, valid = ReprojectionLoss().residuals(
            (lie.exp(xi) @ T)[:, None], (p + dp)[:, None], seen[:, None, None], camera
        )
        return Residuals(value[:, 0, 0] * _tensor(inv_sigma)[:, None], valid[:, 0, 0])

    return _rows(residuals, 3)


def inverse_depth(
    T_c_w: FloatArray, p_w: FloatArray, pose: IntArray, anchor: IntArray, prior: FloatArray, inv_sigma: FloatArray
) -> Rows:
    """Inverse z-depths of anchors in their hosts, predicted minus expected."""
    T, p = _tensor(T_c_w[pose]), _tensor(p_w[anchor])

    def residuals(xi: Tensor, dp: Tensor) -> Residuals:
        z = move(lie.exp(xi) @ T, (p + dp)[:, None])[:, 0, 2:]
        front = z > 1e-6
        value = (1.0 / torch.where(front, z, 1.0) - _tensor(prior)[:, None]) * _tensor(inv_sigma)[:, None]
        return Residuals(torch.where(front, value, 0.0), front[:, 0])

    return _rows(residuals, 3)


def edges(
    T_j_i: FloatArray,
    view: IntArray,
    edge: IntArray,
    uv: FloatArray,
    inverse_depth: FloatArray,
    uv_j: FloatArray,
    normal_j: FloatArray,
    inv_sigma: FloatArray,
    inverse_depth_j: FloatArray,
    cycle: int,
    cycle_inv_sigma: float,
    K: Intrinsics,
) -> Rows:
    """Pairs of an edge pixel and its partner: alignment, and the cycle if enabled."""
    T, at, d, camera = _tensor(T_j_i[view]), _tensor(uv[edge])[:, None], _tensor(inverse_depth[edge]), _matrix(K)
    partner, known = (_tensor(uv_j)[:, None], _tensor(normal_j)[:, None]), _tensor(inverse_depth_j)[:, None]
    depth_j = torch.where(known > 0, 1.0 / torch.where(known > 0, known, 1.0), 0.0)
    # No occlusion mask: pairs were chosen by their depths.
    round_trip = CycleLoss(_FORMS[cycle], max_relative=float("inf")) if cycle in _FORMS else None

    def residuals(xi: Tensor, dd: Tensor) -> Residuals:
        moved, depth = lie.exp(xi) @ T, (1.0 / (d + dd))[:, None]
        across, front = EdgeAlignmentLoss().residuals(moved, at, depth, *partner, camera)
        value = across[:, 0] * _tensor(inv_sigma)[:, None]
        if round_trip is not None:
            back = round_trip.residuals(moved, at, depth, depth_j, camera).value[:, 0] * cycle_inv_sigma
            value = torch.cat((value, back), 1)
        return Residuals(value, front[:, 0])

    return _rows(residuals, 1)


def junctions(
    T_j_i: FloatArray,
    view: IntArray,
    junction: IntArray,
    uv: FloatArray,
    inverse_depth: FloatArray,
    uv_j: FloatArray,
    arms_j: FloatArray,
    inv_sigma_px: float,
    inv_sigma_angle: float,
    cosines: bool,
    K: Intrinsics,
) -> Rows:
    """Pairs of an L-junction and its partner in the target: corner, and arms or the angle between them."""
    T, camera = _tensor(T_j_i[view]), _tensor(np.array(K))
    rays = ((_tensor(uv[junction]) - camera[2:]) / camera[:2]).permute(2, 1, 0)
    d, seen = _tensor(inverse_depth[junction]).mT, (_tensor(uv_j).mT, _tensor(arms_j).permute(2, 1, 0))

    def residuals(xi: Tensor, dd: Tensor) -> Residuals:
        Rt = (lie.exp(xi) @ T)[:, :3].permute(1, 2, 0)
        value, front = junction_residuals(Rt, rays, d + dd[:, None], *seen, camera, cosines)
        weighted = torch.cat((value[:2] * inv_sigma_px, value[2:] * inv_sigma_angle)).mT
        return Residuals(torch.where(front[:, None], weighted, 0.0), front)

    return _rows(residuals, 3)


def _rows(residuals: Callable[[Tensor, Tensor], Residuals], m: int) -> Rows:
    """Residuals ``(n, k)``, derivatives ``(n, k, 6 + m)`` and validity ``(n,)``.

    Each residual depends on one pose and one block: one perturbation common to all yields every derivative.
    """

    def at(step: Tensor) -> tuple[Tensor, Residuals]:
        found = residuals(step[:6], step[6:])
        return found.value, found

    J, (value, valid) = torch.func.jacfwd(at, has_aux=True)(torch.zeros(6 + m, dtype=torch.float64, device=_device()))
    J = torch.where(valid[:, None, None], J, 0.0)
    return value.cpu().numpy(), np.ascontiguousarray(J.cpu().numpy()), valid.cpu().numpy()


def _matrix(K: Intrinsics) -> Tensor:
    fx, fy, cx, cy = K
    return _tensor(np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]))


def _tensor(x: FloatArray) -> Tensor:
    return torch.as_tensor(x, dtype=torch.float64, device=_device())


def _device() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"
