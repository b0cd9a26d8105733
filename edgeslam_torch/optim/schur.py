"""Point elimination: accumulate observation blocks, remove the 3x3 anchor blocks, substitute back.

An observation's point block is first multiplied by the inverse Cholesky factor of its anchor's block; what is
subtracted from the pose system is then one matrix product ``Y^T Y``. Anchors are sorted by the poses that see
them and cut into chunks, so that each chunk's ``Y`` spans only the poses seen in it: one dense product in a
window, a banded one over a whole map.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

_ANCHORS_PER_CHUNK = 1024
_PIVOT = 1e-12
"""A Cholesky pivot below this fraction of its diagonal entry is a direction that nothing observes."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive anchors with the free poses that see them."""

    first: int
    last: int
    """Anchors ``first <= a < last``."""
    rows: Tensor
    """Places of the chunk's observations among the free-pose observations."""
    flat: Tensor
    """``(18 m,)`` places of their blocks in the flattened ``Y``."""
    columns: Tensor
    """``(6 w,)`` scalar columns of the pose system."""


def plan_chunks(obs_column: Tensor, obs_anchor: Tensor, n_anchors: int, n_poses: int) -> list[Chunk]:
    """Cut the anchors ``0..n_anchors`` (already sorted by the poses that see them) into chunks.

    Args:
        obs_column: ``(M,)`` free-pose number of each observation by a free pose.
        obs_anchor: ``(M,)`` its anchor.
        n_anchors: Number of anchors.
        n_poses: Number of free poses.
    """
    order = torch.argsort(obs_anchor, stable=True)
    sorted_anchor = obs_anchor[order]
    size = n_anchors if n_poses <= 16 else _ANCHORS_PER_CHUNK
    six = torch.arange(6, device=obs_column.device)
    three = torch.arange(3, device=obs_column.device)
    chunks = []
    for first in range(0, n_anchors, max(size, 1)):
        last = min(first + size, n_anchors)
        lo, hi = torch.searchsorted(sorted_anchor, torch.tensor([first, last], device=order.device)).tolist()
        if lo == hi:
            continue
        rows = order[lo:hi]
        poses, local = torch.unique(obs_column[rows], return_inverse=True)
        width = 6 * len(poses)
        row = 3 * (obs_anchor[rows] - first) + three[:, None]  # (3, m)
        flat = row[None] * width + (6 * local + six[:, None])[:, None]  # (6, 3, m)
        columns = (6 * poses[:, None] + six).flatten()
        chunks.append(Chunk(first, last, rows, flat.flatten(), columns))
    return chunks


def accumulate_points(target: Tensor, index: Tensor, values: Tensor) -> None:
    """Add ``values (k, m)`` into ``target (k, A)`` at columns ``index``."""
    target.index_add_(1, index, values)


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
