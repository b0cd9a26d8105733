"""Point elimination: accumulate observation blocks, remove the 3x3 anchor blocks, substitute back.

An observation's point block is first multiplied by the inverse Cholesky factor of its anchor's block; what is
subtracted from the pose system is then one matrix product ``Y Y^T``. Anchors are sorted by the poses that see
them and cut into chunks, so that each chunk's ``Y`` spans only the poses seen in it: one dense product in a
window, a banded one over a whole map.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

ANCHORS_PER_CHUNK = 1024
_PIVOT = 1e-12
"""A Cholesky pivot below this fraction of its diagonal entry is a direction that nothing observes."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive anchors with the free poses that see them; its factors are consecutive too."""

    first: int
    last: int
    """Anchors ``first <= a < last``."""
    lo: int
    hi: int
    """Factors ``lo <= m < hi``, sorted by pose, then anchor."""
    flat: Tensor
    """``(18 (hi - lo),)`` places of their 6x3 blocks in the flattened ``Y (6 w, 3 (last - first))``."""
    unique: bool
    """Whether no pose sees an anchor twice: blocks can then be stored without adding."""
    columns: Tensor
    """``(6 w,)`` scalar columns of the pose system."""
    slices: tuple[tuple[int, int, int], ...]
    """Pose, first and last factor of each pose's run."""


def chunk_of(anchor: Tensor, n_poses: int) -> Tensor:
    """Chunk number of each anchor: one chunk for a window of few poses, where cutting saves nothing."""
    return torch.zeros_like(anchor) if n_poses <= 12 else anchor // ANCHORS_PER_CHUNK


def plan_chunks(column: Tensor, anchor: Tensor, n_anchors: int, n_poses: int) -> list[Chunk]:
    """Lay out the ``Y`` of each chunk.

    Args:
        column: ``(M,)`` free-pose number of each factor of a free pose.
        anchor: ``(M,)`` its anchor; factors are sorted by chunk, pose, anchor.
        n_anchors: Number of anchors.
        n_poses: Number of free poses.
    """
    if len(anchor) == 0:
        return []
    size = n_anchors if n_poses <= 12 else ANCHORS_PER_CHUNK
    numbers, counts = torch.unique_consecutive(chunk_of(anchor, n_poses), return_counts=True)
    chunks, lo = [], 0
    for number, count in zip(numbers.tolist(), counts.tolist(), strict=True):
        first, hi = number * size, lo + count
        last = min(first + size, n_anchors)
        poses, local, runs = torch.unique_consecutive(column[lo:hi], return_inverse=True, return_counts=True)
        n = last - first
        place = 18 * n * local + (anchor[lo:hi] - first)  # entry (0, 0) of the block
        inner = (3 * n * torch.arange(6)[:, None] + n * torch.arange(3)).flatten()
        keys = torch.unique(place)
        ends = (lo + runs.cumsum(0)).tolist()
        starts = [lo, *ends[:-1]]
        chunks.append(
            Chunk(
                first=first,
                last=last,
                lo=lo,
                hi=hi,
                flat=(inner[:, None] + place).flatten(),
                unique=len(keys) == count,
                columns=(6 * poses[:, None] + torch.arange(6)).flatten(),
                slices=tuple(zip(poses.tolist(), starts, ends, strict=True)),
            )
        )
        lo = hi
    return chunks


def inverse_cholesky(V: Tensor, damping: float) -> tuple[Tensor, int]:
    """Inverse Cholesky factors of 3x3 blocks, closed form.

    Args:
        V: ``(6, A)`` upper triangles xx, xy, xz, yy, yz, zz.
        damping: Relative to the diagonal.

    Returns:
        ``(6, A)`` factors a, b, c, d, e, f with ``L^-1 = [[a, 0, 0], [b, c, 0], [d, e, f]]``, zero in a
        direction that nothing observes, so that it neither moves nor acts on the poses; and how many anchors
        have one.
    """
    d = 1.0 + damping
    xx, xy, xz, yy, yz, zz = V.unbind(0)
    xx, yy, zz = xx * d, yy * d, zz * d
    l00 = _reciprocal_root(xx, xx)
    l10, l20 = xy * l00, xz * l00
    l11 = _reciprocal_root(yy - l10 * l10, yy)
    l21 = (yz - l20 * l10) * l11
    l22 = _reciprocal_root(zz - l20 * l20 - l21 * l21, zz)
    b = -l10 * l00 * l11
    e = -l21 * l11 * l22
    out = torch.stack((l00, b, l11, -(l20 * l00 + l21 * b) * l22, e, l22))
    deficient = int(((l00 == 0) | (l11 == 0) | (l22 == 0)).sum())
    return out, deficient


def _reciprocal_root(pivot: Tensor, scale: Tensor) -> Tensor:
    return torch.where(pivot > _PIVOT * scale, pivot, torch.inf).rsqrt()


def whiten(factor: Tensor, g: Tensor) -> Tensor:
    """``L^-1 g`` of vectors ``(3, A)``; ``factor`` as `inverse_cholesky` returns it."""
    a, b, c, d, e, f = factor
    return torch.stack((a * g[0], b * g[0] + c * g[1], d * g[0] + e * g[1] + f * g[2]))


def unwhiten(factor: Tensor, y: Tensor) -> Tensor:
    """``L^-T y`` of vectors ``(3, A)``."""
    a, b, c, d, e, f = factor
    return torch.stack((a * y[0] + b * y[1] + d * y[2], c * y[1] + e * y[2], f * y[2]))
