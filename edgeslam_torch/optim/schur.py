"""Elimination of small blocks: anchors (3), edge depths (1), junctions (3).

A factor's block derivatives are first multiplied by the inverse Cholesky factor of its block; what is subtracted
from the pose system is then one matrix product ``Y Y^T``. Blocks are sorted by the poses that see them and cut
into chunks, so that each chunk's ``Y`` spans only the poses seen in it: one dense product in a window, a banded
one over a whole map.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

_PIVOT = 1e-12
"""A Cholesky pivot below this fraction of its diagonal entry is a direction that nothing observes."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive blocks with the poses that see them; its factors are consecutive too."""

    first: int
    last: int
    """Blocks ``first <= a < last``."""
    lo: int
    hi: int
    """Factors ``lo <= m < hi``, sorted by pose, then block."""
    flat: Tensor
    """Places of their ``6 x size`` entries in the flattened ``Y (6 w, size (last - first))``."""
    unique: bool
    """Whether no pose sees a block twice: entries can then be stored without adding."""
    columns: Tensor
    """``(6 w,)`` scalar columns of the pose system."""
    slices: tuple[tuple[int, int, int], ...]
    """Pose, first and last factor of each pose's run."""


def plan_chunks(column: Tensor, block: Tensor, bounds: Sequence[int], size: int) -> list[Chunk]:
    """Lay out the ``Y`` of each chunk.

    Args:
        column: ``(M,)`` pose number of each factor.
        block: ``(M,)`` its block; factors are sorted by chunk, pose, block.
        bounds: First block of each chunk and, last, the number of blocks.
        size: Unknowns per block.
    """
    edges = torch.tensor(bounds[1:], dtype=block.dtype)
    counts = torch.bincount(torch.bucketize(block, edges, right=True), minlength=len(edges)).tolist()
    chunks, lo = [], 0
    for first, last, count in zip(bounds[:-1], bounds[1:], counts, strict=True):
        if count == 0:
            continue
        hi, n = lo + count, last - first
        poses, local, runs = torch.unique_consecutive(column[lo:hi], return_inverse=True, return_counts=True)
        place = 6 * size * n * local + (block[lo:hi] - first)  # entry (0, 0)
        inner = (size * n * torch.arange(6)[:, None] + n * torch.arange(size)).flatten()
        ends = (lo + runs.cumsum(0)).tolist()
        chunks.append(
            Chunk(
                first=first,
                last=last,
                lo=lo,
                hi=hi,
                flat=(inner[:, None] + place).flatten(),
                unique=bool((place[1:] > place[:-1]).all()),
                columns=(6 * poses[:, None] + torch.arange(6)).flatten(),
                slices=tuple(zip(poses.tolist(), [lo, *ends[:-1]], ends, strict=True)),
            )
        )
        lo = hi
    return chunks


def fill(Y: Tensor, chunk: Chunk, entries: Tensor) -> None:
    """Store a chunk's entries ``(6, size, hi - lo)`` in its ``Y``."""
    if chunk.unique:
        Y.view(-1).index_copy_(0, chunk.flat, entries.flatten())
    else:
        Y.zero_().view(-1).index_add_(0, chunk.flat, entries.flatten())


def row_products(a: Tensor, b: Tensor) -> Tensor:
    """Sum over residual rows of outer products: ``(R, m, M)`` and ``(R, n, M)`` to ``(m, n, M)``."""
    out = a[0][:, None] * b[0]
    for k in range(1, a.shape[0]):
        out.addcmul_(a[k][:, None], b[k])
    return out


def triangle(J: Tensor) -> Tensor:
    """Upper triangles of the blocks' own normal matrices: ``(R, size, M)`` to ``(size (size + 1) / 2, M)``."""
    size = J.shape[1]
    out = torch.empty(size * (size + 1) // 2, J.shape[2], dtype=J.dtype, device=J.device)
    at = 0
    for i in range(size):
        for j in range(i, size):
            torch.mul(J[0, i], J[0, j], out=out[at])
            for k in range(1, J.shape[0]):
                out[at].addcmul_(J[k, i], J[k, j])
            at += 1
    return out


def diagonal_rows(size: int) -> list[int]:
    """Rows of `triangle`'s output that hold the diagonal."""
    return [0] if size == 1 else [0, 3, 5]


def inverse_cholesky(V: Tensor, damping: float) -> Tensor:
    """Inverse Cholesky factors of 1x1 or 3x3 blocks, closed form.

    Args:
        V: ``(1, A)`` values, or ``(6, A)`` upper triangles xx, xy, xz, yy, yz, zz.
        damping: Relative to the diagonal.

    Returns:
        ``(1, A)`` or ``(6, A)``: a, b, c, d, e, f with ``L^-1 = [[a, 0, 0], [b, c, 0], [d, e, f]]``; zero in a
        direction that nothing observes, so that it neither moves nor acts on the poses.
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


def whiten(factor: Tensor, g: Tensor) -> Tensor:
    """``L^-1 g`` of vectors ``(size, A)``, or of ``(R, size, A)``; ``factor`` as `inverse_cholesky` returns it."""
    if factor.shape[0] == 1:
        return g * factor[0]
    a, b, c, d, e, f = factor
    x, y, z = g.unbind(-2)
    second = torch.addcmul(b * x, c, y)
    return torch.stack((a * x, second, torch.addcmul(torch.addcmul(d * x, e, y), f, z)), -2)


def entries(factor: Tensor, block: Tensor, Jp: Tensor, Jb: Tensor) -> Tensor:
    """What factors put into `Chunk`'s ``Y``: ``Jp^T Jb L^-T``, ``(6, size, M)``.

    Args:
        factor: Of the blocks, as `inverse_cholesky` returns it.
        block: ``(M,)`` each factor's block.
        Jp: ``(R, 6, M)`` derivatives by the pose.
        Jb: ``(R, size, M)`` by the block.
    """
    return row_products(Jp, whiten(factor.index_select(1, block), Jb))


def unwhiten(factor: Tensor, y: Tensor) -> Tensor:
    """``L^-T y`` of vectors ``(size, A)``."""
    if factor.shape[0] == 1:
        return y * factor[0]
    a, b, c, d, e, f = factor
    return torch.stack((a * y[0] + b * y[1] + d * y[2], c * y[1] + e * y[2], f * y[2]))
