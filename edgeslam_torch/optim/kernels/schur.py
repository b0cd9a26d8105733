"""Elimination of small blocks: anchors (3), edge depths (1), junctions (3).

A factor's block derivatives are first multiplied by the inverse Cholesky factor of its block; the Schur term of the
pose system is then one matrix product ``Y Y^T``.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

_PIVOT = 1e-12
"""A Cholesky pivot below this fraction of its diagonal entry is an unobservable direction."""


def diagonal_rows(size: int) -> list[int]:
    """Rows of `triangle`'s output that hold the diagonal."""
    return [0] if size == 1 else [0, 3, 5]


def inverse_cholesky(V: Tensor, damping: float | Tensor) -> Tensor:
    """Inverse Cholesky factors of 1x1 or 3x3 blocks, closed form.

    Args:
        V: ``(1, ...)`` values, or ``(6, ...)`` upper triangles xx, xy, xz, yy, yz, zz.
        damping: Relative to the diagonal.

    Returns:
        ``(1, ...)`` or ``(6, ...)``: a, b, c, d, e, f with ``L^-1 = [[a, 0, 0], [b, c, 0], [d, e, f]]``; zero in
        unobservable directions, which neither move nor affect the poses.
    """
    grow = 1.0 + damping
    if V.shape[0] == 1:
        return _reciprocal_root(V * grow, V * grow)
    xx, xy, xz, yy, yz, zz = V.unbind(0)
    xx, yy, zz = xx * grow, yy * grow, zz * grow
    a = _reciprocal_root(xx, xx)
    l10, l20 = xy * a, xz * a
    c = _reciprocal_root(yy - l10 * l10, yy)
    l21 = (yz - l20 * l10) * c
    f = _reciprocal_root(zz - l20 * l20 - l21 * l21, zz)
    b = -l10 * a * c
    return torch.stack((a, b, c, -(l20 * a + l21 * b) * f, -l21 * c * f, f))


def _reciprocal_root(pivot: Tensor, scale: Tensor) -> Tensor:
    return torch.where(pivot > _PIVOT * scale, pivot, torch.inf).rsqrt()


def whiten(factor: Tensor, g: Tensor, dim: int = -2) -> Tensor:
    """``L^-1 g`` of vectors whose components lie along ``dim``; ``factor`` as `inverse_cholesky` returns it."""
    if factor.shape[0] == 1:
        return (g.select(dim, 0) * factor[0]).unsqueeze(dim)
    a, b, c, d, e, f = factor
    x, y, z = g.unbind(dim)
    second = torch.addcmul(b * x, c, y)
    return torch.stack((a * x, second, torch.addcmul(torch.addcmul(d * x, e, y), f, z)), dim)


def unwhiten(factor: Tensor, y: Tensor) -> Tensor:
    """``L^-T y`` of vectors ``(size, ...)``."""
    if factor.shape[0] == 1:
        return y * factor[0]
    a, b, c, d, e, f = factor
    return torch.stack((a * y[0] + b * y[1] + d * y[2], c * y[1] + e * y[2], f * y[2]))


def pair_products(
    J: Sequence[Sequence[Tensor]], Jd: Sequence[Sequence[Tensor]]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normal equations of pairs in tiles (`optim.kernels.tiles`), before the blocks are eliminated.

    Args:
        J: For each residual row its seven weighted derivatives ``(B, T, L)`` by the relative pose, the residual last.
        Jd: For each row its weighted derivatives ``(B, T, L)`` by the ``size`` values of the block.

    Returns:
        Normal matrices of the relative poses with their gradients ``(B, T, 7, 7)``, their products with the blocks
        ``(B, T, 6, size, L)``, the blocks' upper triangles ``(size (size + 1) / 2, B, L)`` and
        gradients ``(size, B, L)``.
    """
    size = len(Jd[0])
    if torch.compiler.is_compiling():  # a single pass over the pairs that writes only the cross products
        upper = torch.stack([_summed(J, k, J, m).sum(-1) for k in range(7) for m in range(k, 7)], -1)
        normal = upper[..., torch.tensor(_PLACES, device=upper.device)]
        cross = torch.stack([_summed(J, k, Jd, m) for k in range(6) for m in range(size)], 2).unflatten(2, (6, size))
    else:
        rows = torch.stack([row[k] for k in range(7) for row in J], 2).unflatten(2, (7, len(J)))
        blocks = torch.stack([row[m] for m in range(size) for row in Jd], 2).unflatten(2, (size, len(J)))
        flat = rows.flatten(3)
        normal = flat @ flat.mT
        cross = rows[:, :, :6, None, 0] * blocks[:, :, None, :, 0]
        for r in range(1, len(J)):
            cross = torch.addcmul(cross, rows[:, :, :6, None, r], blocks[:, :, None, :, r])
    own = [_summed(Jd, k, Jd, m).sum(1) for k in range(size) for m in range(k, size)]
    g = [_summed(J, 6, Jd, m).sum(1) for m in range(size)]
    return normal, cross, torch.stack(own), torch.stack(g)


_PLACES = [[min(k, m) * (13 - min(k, m)) // 2 + max(k, m) for m in range(7)] for k in range(7)]
"""Indices of a symmetric 7x7 matrix in its upper triangle, row by row."""


def _summed(a: Sequence[Sequence[Tensor]], i: int, b: Sequence[Sequence[Tensor]], j: int) -> Tensor:
    """Sum over residual rows of the products of columns ``i`` and ``j``."""
    out = a[0][i] * b[0][j]
    for x, y in zip(a[1:], b[1:], strict=True):
        out = torch.addcmul(out, x[i], y[j])
    return out


def eliminate(V: Tensor, g: Tensor, cross: Tensor, damping: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Eliminate blocks in tiles from the pose system.

    Args:
        V: Upper triangles ``(size (size + 1) / 2, B, L)``.
        g: Gradients ``(size, B, L)``.
        cross: As `pair_products` returns it.
        damping: Relative to the diagonal ``()``.

    Returns:
        Inverse Cholesky factors of the blocks, their whitened gradients ``(size, B, L)``, ``Y^T (B, size L, 6 T)``,
        and the Schur terms to subtract from the tiles' pose systems ``Y Y^T (B, 6 T, 6 T)`` and right sides ``(B, 6
        T)``.
    """
    factor = inverse_cholesky(V, damping)
    y = whiten(factor, g, 0)
    B, T, _, size, L = cross.shape
    Y = whiten(factor.to(cross.dtype)[:, :, None, None], cross, 3).view(B, 6 * T, size * L)
    right = y.to(cross.dtype).transpose(0, 1).reshape(B, 1, size * L)
    # With the long axis first the product is three times as fast, the copy included.
    Y_T = torch.cat((Y, right), 1).mT.contiguous()
    products = (Y_T.mT @ Y_T).double()
    return factor, y, Y_T[..., :-1], products[:, :-1, :-1], products[:, :-1, -1]
