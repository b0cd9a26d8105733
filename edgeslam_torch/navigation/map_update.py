"""Map corrections: positions stored in the map move with the view nearest to them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """Poses of past views before and after a map correction, and the change of scale."""

    before_w: FloatArray
    """``(N, 4, 4)`` ``T_w_c`` before the correction, N >= 1."""
    after_w: FloatArray
    """``(N, 4, 4)`` ``T_w_c`` of the same views after it."""
    ratio: float = 1.0
    """Length after the correction over length before it."""
    pictures: IntArray | None = None
    """``(N,)`` frame numbers of the views, ascending; None if unknown."""

    def poses(self, T_w_c: FloatArray) -> FloatArray:
        """Corrected poses ``(M, 4, 4)``; each moves with the view nearest to it."""
        k = self._nearest(T_w_c[:, :3, 3])
        relative = se3.inverse(self.before_w[k]) @ T_w_c
        relative[:, :3, 3] *= self.ratio
        return np.asarray(self.after_w[k] @ relative)

    def points(self, p_w: FloatArray, seen_in: Sequence[int] | None = None) -> FloatArray:
        """Corrected points ``(M, 3)``, or ``(M, 2)`` at the height of their views.

        Args:
            p_w: Points before the correction [m].
            seen_in: Frame numbers in which they were observed; -1 if unknown. A point then moves with the view nearest
                in time, since a misplaced submap may overlap it in space.
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
        moved = self.ratio * np.einsum("mij,mj->mi", turn, step) + after[:, :3, 3]
        return np.asarray(moved[:, : p_w.shape[1]])

    def _nearest(self, p_w: FloatArray) -> np.ndarray:
        """Index ``(M,)`` of the view nearest to each point ``(M, 2 or 3)``; the newest on a tie."""
        size = p_w.shape[1]
        away = np.linalg.norm(p_w[:, None] - self.before_w[::-1, :size, 3], axis=2)
        return np.asarray(len(self.before_w) - 1 - away.argmin(1))


def moves(before_w: FloatArray, after_w: FloatArray, least_m: float) -> bool:
    """Whether any of the views ``(N, 4, 4)`` moved by more than ``least_m``."""
    return bool((np.linalg.norm(after_w[:, :3, 3] - before_w[:, :3, 3], axis=1) > least_m).any())
