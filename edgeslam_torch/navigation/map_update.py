"""How a map moved under a pilot: what was remembered in its axes goes along with the nearest view."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """Where the views are now that a pilot was told of, and by how much their unit grew."""

    before_w: FloatArray
    """``(N, 4, 4)`` ``T_w_c`` as they were told, N at least 1."""
    after_w: FloatArray
    """``(N, 4, 4)`` the same views now."""
    ratio: float = 1.0
    """Of lengths now to lengths then."""
    pictures: IntArray | None = None
    """``(N,)`` numbers of the pictures that the views were seen in, ascending; None: they have none."""

    def poses(self, T_w_c: FloatArray) -> FloatArray:
        """Poses ``(M, 4, 4)``, each carried along with the view nearest to it."""
        k = self._nearest(T_w_c[:, :3, 3])
        relative = se3.inverse(self.before_w[k]) @ T_w_c
        relative[:, :3, 3] *= self.ratio
        return np.asarray(self.after_w[k] @ relative)

    def points(self, p_w: FloatArray, seen_in: Sequence[int] | None = None) -> FloatArray:
        """Points ``(M, 3)``, or places ``(M, 2)`` at the height of their views, likewise.

        Args:
            p_w: Where they were.
            seen_in: Numbers of the pictures that showed them: they go along with the view nearest to that in time, not
                with a piece of map that lay across them by mistake. -1 where that is not known.
        """
        p_w = np.asarray(p_w, dtype=np.float64)
        if len(p_w) == 0:
            return p_w
        k = self._nearest(p_w)
        if seen_in is not None and self.pictures is not None:
            seen = np.asarray(seen_in)
            in_time = np.abs(seen[:, None] - self.pictures).argmin(axis=1)
            k = np.where(seen >= 0, in_time, k)
        before, after = self.before_w[k], self.after_w[k]
        step = np.zeros((len(p_w), 3))
        step[:, : p_w.shape[1]] = p_w - before[:, : p_w.shape[1], 3]
        turn = after[:, :3, :3] @ before[:, :3, :3].swapaxes(1, 2)
        carried = self.ratio * np.einsum("mij,mj->mi", turn, step) + after[:, :3, 3]
        return np.asarray(carried[:, : p_w.shape[1]])

    def _nearest(self, p_w: FloatArray) -> np.ndarray:
        """The view ``(M,)`` nearest to each point ``(M, 2 or 3)``, the newest of several."""
        size = p_w.shape[1]
        away = np.linalg.norm(p_w[:, None] - self.before_w[::-1, :size, 3], axis=2)
        return np.asarray(len(self.before_w) - 1 - away.argmin(1))


def moves(before_w: FloatArray, after_w: FloatArray, least_m: float) -> bool:
    """Whether any of the views ``(N, 4, 4)`` is somewhere else by now."""
    return bool((np.linalg.norm(after_w[:, :3, 3] - before_w[:, :3, 3], axis=1) > least_m).any())
