"""SE(3) in torch, batched and differentiable; same conventions as `geometry.se3`."""

import torch
from torch import Tensor

_SMALL = 1e-4
"""Below this angle [rad] the Taylor terms are exact to float64 (next term ~ angle^4 / 5040)."""


def hat(v: Tensor) -> Tensor:
    """Cross-product matrices ``(..., 3, 3)`` of ``(..., 3)``."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack((o, -z, y, z, o, -x, -y, x, o), -1).reshape(*v.shape[:-1], 3, 3)


def exp(xi: Tensor) -> Tensor:
    """Rigid motions ``(..., 4, 4)`` of tangents ``(..., 6)``, translation first (Barfoot 2017, eq. 7.86)."""
    rho, phi = xi[..., :3], xi[..., 3:]
    theta2 = (phi * phi).sum(-1)[..., None, None]
    small = theta2 < _SMALL**2
    safe = torch.where(small, torch.ones_like(theta2), theta2)
    theta = safe.sqrt()
    a = torch.where(small, 1.0 - theta2 / 6.0, torch.sin(theta) / theta)
    b = torch.where(small, 0.5 - theta2 / 24.0, (1.0 - torch.cos(theta)) / safe)
    c = torch.where(small, 1.0 / 6.0 - theta2 / 120.0, (theta - torch.sin(theta)) / (safe * theta))
    W = hat(phi)
    WW = W @ W
    eye = torch.eye(3, dtype=xi.dtype, device=xi.device)
    t = ((eye + b * W + c * WW) @ rho[..., None])[..., 0]
    return pack(eye + a * W + b * WW, t)


def pack(R: Tensor, t: Tensor) -> Tensor:
    """``(..., 4, 4)`` from rotation ``(..., 3, 3)`` and translation ``(..., 3)``."""
    top = torch.cat((R, t[..., None]), -1)
    bottom = torch.zeros_like(top[..., :1, :])
    bottom[..., 0, 3] = 1.0
    return torch.cat((top, bottom), -2)


def inverse(T: Tensor) -> Tensor:
    """Inverse of rigid motions ``(..., 4, 4)``."""
    R_t = T[..., :3, :3].mT
    return pack(R_t, -(R_t @ T[..., :3, 3:])[..., 0])


def adjoint(T: Tensor) -> Tensor:
    """``(..., 6, 6)`` with ``T exp(xi) = exp(adjoint(T) xi) T``."""
    R, t = T[..., :3, :3], T[..., :3, 3]
    top = torch.cat((R, hat(t) @ R), -1)
    bottom = torch.cat((torch.zeros_like(R), R), -1)
    return torch.cat((top, bottom), -2)
