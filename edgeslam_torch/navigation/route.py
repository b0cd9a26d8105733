"""Global planner: cost to go over a layer, optimistic about unknown cells."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.types import FloatArray

_NEIGHBOURS = ((1, 0), (0, 1), (1, 1), (1, -1))
_UNSEEN_COST = 2.5
"""Cost per metre of unknown space: a known path up to this many times longer is preferred."""
_NARROW_COST = 10.0
"""Cost per metre of a gap narrower than the required clearance. Gaps look narrower from afar, so a closer look pays off
before a detour of this many metres."""
TIGHT_M, _TIGHT_COST = 0.45, 2.0
"""Distance to obstacles below which a metre costs up to this much more, so that paths keep to the middle."""


@dataclass(frozen=True, slots=True)
class CostToGo:
    """Weighted path length [m] from every cell to the nearest goal; infinite if unreachable."""

    layer: Layer
    cost: FloatArray
    """``(X, Y)``."""

    def at(self, p_w: FloatArray) -> FloatArray:
        """Cost at points ``(..., 2)``, interpolated between reachable cells: a slow move ends in the same cell."""
        reachable = np.isfinite(self.cost)
        share = self.layer.interpolated(reachable.astype(np.float64), p_w, 0.0)
        cost = self.layer.interpolated(np.where(reachable, self.cost, 0.0), p_w, 0.0)
        return np.divide(cost, share, out=np.full_like(cost, np.inf), where=share > 0.0)

    def way(self, p_w: FloatArray, length_m: float) -> FloatArray:
        """Cheapest path from a point ``(2,)``: cell centres ``(N, 2)``, up to ``length_m`` or the goal."""
        here = self.layer.cells(p_w)
        out = [self.layer.centres(here)]
        steps = int(length_m / self.layer.cell_m)
        for _ in range(steps):
            low = np.maximum(here - 1, 0)
            around = self.cost[low[0] : here[0] + 2, low[1] : here[1] + 2]
            best = low + np.array(np.unravel_index(int(np.argmin(around)), around.shape))
            if (best == here).all() or not np.isfinite(self.cost[tuple(best)]):
                break
            here = best
            out.append(self.layer.centres(here))
        return np.array(out)


def cost_to_go(layer: Layer, goals: np.ndarray, clearance_m: float, hull_m: float, here: np.ndarray) -> CostToGo:
    """Cost to go from every cell to the goals (Dijkstra from the goals).

    Args:
        layer: Free, occupied and unknown cells.
        goals: Cells ``(G, 2)``; those inside of obstacles are ignored.
        clearance_m: Required distance of the drone's centre from obstacles.
        hull_m: Distance down to which paths are planned at high cost, though they may not be flown.
        here: The drone's cell ``(2,)``; the path may start closer to an obstacle.
    """
    away_m, slack_m = layer.from_solid_m, 0.5 * layer.cell_m
    open_ = away_m > hull_m - slack_m
    low = np.maximum(here - 2, 0)
    open_[low[0] : here[0] + 3, low[1] : here[1] + 3] |= ~layer.solid[low[0] : here[0] + 3, low[1] : here[1] + 3]
    tight = np.clip(1.0 - (away_m - clearance_m) / TIGHT_M, 0.0, 1.0)
    weight = np.where(layer.free, 1.0, _UNSEEN_COST) + _TIGHT_COST * tight
    weight = np.where(away_m > clearance_m - slack_m, weight, weight + _NARROW_COST).ravel()
    first, second, length = _edges(layer.free.shape)
    kept = open_.ravel()[first] & open_.ravel()[second]
    a, b = first[kept], second[kept]
    graph = csr_array(
        (length[kept] * layer.cell_m * 0.5 * (weight[a] + weight[b]), (a.astype(np.int32), b.astype(np.int32))),
        shape=(open_.size, open_.size),
    )
    at_goals = np.zeros(open_.shape, bool)
    at_goals[tuple(np.asarray(goals, dtype=int).T)] = True
    sources = np.flatnonzero(at_goals & open_)
    if len(sources) == 0:
        return CostToGo(layer, np.full(open_.shape, np.inf))
    # SciPy 1.13 requires 32-bit indices; a grid has 25 600 cells.
    cost = dijkstra(graph, directed=False, indices=sources.astype(np.int32), min_only=True)
    return CostToGo(layer, np.asarray(cost).reshape(open_.shape))


@lru_cache(maxsize=4)
def _edges(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, FloatArray]:
    """Flat indices of neighbouring cells and their distance in cells."""
    index = np.arange(shape[0] * shape[1]).reshape(shape)
    first, second, length = [], [], []
    for di, dj in _NEIGHBOURS:
        a = index[: shape[0] - di, max(0, -dj) : shape[1] - max(0, dj)]
        b = index[di:, max(0, dj) : shape[1] + min(0, dj)]
        first.append(a.ravel())
        second.append(b.ravel())
        length.append(np.full(a.size, float(np.hypot(di, dj))))
    return np.concatenate(first), np.concatenate(second), np.concatenate(length)
