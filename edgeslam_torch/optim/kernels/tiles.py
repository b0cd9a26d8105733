"""Dense layout of blocks and of the pairs that see them: host by target by block, without gathers or scatters.

The blocks of one host are cut into tiles of equal length. A pair lies in its block's column and its target's row of
that tile; empty slots have zero weight. Sums over a block's pairs, over a target's pairs and the product that
eliminates the blocks are then sums along an axis and batched matrix products. All edges of a host share the same few
targets, so most slots are occupied.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.types import FloatArray, IntArray

_MAX_LANES = 2048
"""Maximum blocks per tile, since hosts differ in size."""
_VECTOR = 16
"""Tile lengths are a multiple of this: single-precision numbers per vector register."""


@dataclass(frozen=True, slots=True)
class Tiles:
    """``B`` tiles of ``T`` targets by ``L`` blocks."""

    host: Tensor
    """``(B,)`` host pose of each tile."""
    target: Tensor
    """``(B, T)`` target poses; the host itself where a tile has fewer."""
    lanes: int
    """``L``."""
    block_place: IntArray
    """``(E,)`` indices of the blocks in ``B L``."""
    pair_place: IntArray
    """``(P,)`` indices of the pairs in ``B T L``."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """``B``, ``T``, ``L``."""
        return *self.target.shape, self.lanes

    def blocks(self, values: FloatArray, dtype: torch.dtype, empty: float = 0.0) -> Tensor:
        """Values ``(..., E)`` of the blocks arranged as ``(..., B, L)``."""
        B, _, L = self.shape
        return _spread(values, self.block_place, (B, L), dtype, empty)

    def pairs(self, values: FloatArray, dtype: torch.dtype, empty: float = 0.0) -> Tensor:
        """Values ``(..., P)`` of the pairs arranged as ``(..., B, T, L)``."""
        return _spread(values, self.pair_place, self.shape, dtype, empty)

    def of_blocks(self, values: Tensor) -> FloatArray:
        """Values ``(..., B, L)`` back in the order of the blocks ``(..., E)``."""
        out: FloatArray = values.cpu().numpy().reshape(*values.shape[:-2], -1)[..., self.block_place]
        return out

    def of_pairs(self, values: Tensor) -> FloatArray:
        """Values ``(..., B, T, L)`` back in the order of the pairs ``(..., P)``."""
        out: FloatArray = values.cpu().numpy().reshape(*values.shape[:-3], -1)[..., self.pair_place]
        return out


def lay_out(host: IntArray, pair_block: IntArray, pair_pose: IntArray, poses: int) -> Tiles:
    """Assign blocks and pairs to slots; a host of usual size is one tile.

    Args:
        host: ``(E,)`` host poses.
        pair_block: ``(P,)`` blocks of the pairs.
        pair_pose: ``(P,)`` target poses.
        poses: Number of poses.

    Raises:
        ValueError: If a pair's target is its host, or a block is paired with one target twice.
    """
    host, pair_block, pair_pose = (np.asarray(x, dtype=np.int64) for x in (host, pair_block, pair_pose))
    count = np.bincount(host, minlength=poses)
    most = max(int(count.max(initial=0)), 1)
    lanes = -(-most // -(-most // _MAX_LANES))
    lanes = -(-lanes // _VECTOR) * _VECTOR
    order = np.argsort(host, kind="stable")
    within = np.empty_like(order)
    within[order] = np.arange(len(host)) - np.repeat(np.cumsum(count) - count, count)
    tiles = -(-count // lanes)
    tile = (np.cumsum(tiles) - tiles)[host] + within // lanes
    lane = within % lanes
    tile_host = np.repeat(np.arange(poses), tiles)
    B = len(tile_host)
    # Few passes, since there are many pairs.
    row = tile[pair_block] * poses + pair_pose
    seen = (np.bincount(row, minlength=B * poses) > 0).reshape(B, poses)
    if seen[np.arange(B), tile_host].any():
        raise ValueError("a pair's target pose must differ from its host")
    slot = np.cumsum(seen, axis=1) - 1
    slots = max(int(seen.sum(1).max(initial=0)), 1)
    target = np.repeat(tile_host[:, None], slots, axis=1)
    which, pose = np.nonzero(seen)
    target[which, slot[which, pose]] = pose
    start = (np.arange(B)[:, None] * slots + slot) * lanes
    pair_place = start.reshape(-1)[row] + lane[pair_block]
    taken = np.zeros(target.size * lanes, dtype=bool)
    taken[pair_place] = True
    if np.count_nonzero(taken) != len(pair_place):
        raise ValueError("a block must be paired with a target pose only once")
    return Tiles(torch.as_tensor(tile_host), torch.as_tensor(target), lanes, tile * lanes + lane, pair_place)


def _spread(values: FloatArray, place: IntArray, shape: tuple[int, ...], dtype: torch.dtype, empty: float) -> Tensor:
    kind = np.float32 if dtype is torch.float32 else np.float64
    rows = np.asarray(values, dtype=kind).reshape(-1, len(place))
    out = np.full((len(rows), int(np.prod(shape))), empty, dtype=kind)
    for to, row in zip(out, rows, strict=True):  # row by row: numpy is slow with an index behind an ellipsis
        to[place] = row
    return torch.as_tensor(out.reshape(*np.shape(values)[:-1], *shape))
