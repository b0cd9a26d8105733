"""Positions that follow the map: each is stored in the frame of the view in which it was seen.

A loop, a joined submap or a revision of metres corrects the poses of the views. Positions relative to them follow
without an update of their own.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray, IntArray

_NO_PICTURE = -1


@dataclass(frozen=True, slots=True)
class MapUpdate:
    """Correction of the map: poses of past views, and the change of scale. Views that are left out go with the nearest
    in time."""

    pictures: IntArray
    """``(N,)`` frame numbers of the views, ascending."""
    T_w_c: FloatArray
    """``(N, 4, 4)`` their poses after the correction [m]."""
    ratio: float = 1.0
    """Length after the correction over length before it."""


class MapViews:
    """Poses of the views so far; before the first one, positions are tied to the take-off, which never moves.

    One thread adds and corrects; others may read meanwhile.

    Example:
        >>> views = MapViews()
        >>> views.add(7, np.eye(4))
        >>> places = Places(views, [[2.0, 1.0]])
        >>> shifted = np.eye(4)
        >>> shifted[0, 3] = 0.5
        >>> views.correct(MapUpdate(np.array([7]), shifted[None]))
        >>> places.p_w.tolist()
        [[2.5, 1.0]]
    """

    def __init__(self) -> None:
        self._pictures: IntArray = np.array([_NO_PICTURE])
        self._now: tuple[FloatArray, float] = np.eye(4)[None], 1.0
        """Poses ``(V, 4, 4)``, and length now over length at the beginning: replaced together."""

    @property
    def now(self) -> tuple[FloatArray, float]:
        """Present poses ``(V, 4, 4)``, the take-off first and the newest last, and the scale."""
        return self._now

    def add(self, picture: int, T_w_c: FloatArray) -> None:
        """Add the newest view by its frame number and pose ``(4, 4)``; one that is not newer changes nothing."""
        if picture > self._pictures[-1]:
            T, scale = self._now
            self._pictures, self._now = np.append(self._pictures, picture), (np.concatenate([T, T_w_c[None]]), scale)

    def correct(self, update: MapUpdate) -> None:
        """Apply a correction."""
        T, scale = self._now
        known = np.flatnonzero(np.isin(update.pictures, self._pictures[1:]))
        corrected = T.copy()
        corrected[:, :3, 3] *= update.ratio
        if len(known):
            nearest = known[np.abs(self._pictures[1:, None] - update.pictures[known]).argmin(axis=1)]
            before = T[np.searchsorted(self._pictures, update.pictures[nearest])]
            relative = se3.inverse(before) @ T[1:]
            relative[:, :3, 3] *= update.ratio
            corrected[1:] = update.T_w_c[nearest] @ relative
        self._now = corrected, scale * update.ratio

    def pose_of(self, picture: int) -> FloatArray | None:
        """Present pose ``(4, 4)`` of a view by its frame number; None if it is unknown."""
        at = int(np.searchsorted(self._pictures, picture))
        found = picture != _NO_PICTURE and at < len(self._pictures) and self._pictures[at] == picture
        return self._now[0][at] if found else None


class Places:
    """Points of the map, each tied to a view.

    Args:
        views: The views of the map; only needed with points.
        p_w: As for `add`.
        size: Number of coordinates, 2 or 3; points with two lie at the height of their view.
    """

    def __init__(self, views: MapViews | None = None, p_w: ArrayLike = (), size: int = 2) -> None:
        self._views = views or MapViews()
        self._size = size
        self._view: IntArray = np.zeros(0, int)
        self._local: FloatArray = np.zeros((0, 3))
        """In the frame of its view, in the unit of the beginning."""
        self.add(self._views, p_w)

    def add(self, views: MapViews, p_w: ArrayLike, nearest: bool = False) -> None:
        """Add points.

        Args:
            views: The views of the map, the same in every call.
            p_w: ``(N, size)`` [m].
            nearest: Whether to tie each to the nearest view, as a path flown long ago, instead of the newest.
        """
        points = np.asarray(p_w, dtype=np.float64).reshape(-1, self._size)
        if len(points) == 0:
            return
        (T, _), self._views = views.now, views
        view = np.full(len(points), len(T) - 1)
        if nearest and len(T) > 1:  # the last one on a tie: the map may have been corrected there
            away = np.linalg.norm(points[:, None] - T[:0:-1, : self._size, 3], axis=2)
            view -= away.argmin(axis=1)
        self._view = np.concatenate([self._view, view])
        self._local = np.concatenate([self._local, self._in_views(view, points)])

    def move(self, p_w: FloatArray) -> None:
        """Estimate the points anew, ``(N, size)``; they stay tied to their views."""
        self._local = self._in_views(self._view, p_w)

    def _in_views(self, view: IntArray, p_w: FloatArray) -> FloatArray:
        """Points ``(N, size)`` in the frames of views ``(N,)``, in the unit of the beginning."""
        T, scale = self._views.now
        step = np.zeros((len(p_w), 3))
        step[:, : self._size] = p_w - T[view, : self._size, 3]
        return np.asarray(np.einsum("nji,nj->ni", T[view, :3, :3], step) / scale)

    @property
    def p_w(self) -> FloatArray:
        """``(N, size)`` where they are now [m]."""
        T, scale = self._views.now
        T = T[self._view]
        p = scale * np.einsum("nij,nj->ni", T[:, :3, :3], self._local) + T[:, :3, 3]
        return np.asarray(p[:, : self._size])

    @property
    def last_w(self) -> FloatArray:
        """``(size,)`` the last of them."""
        T, scale = self._views.now
        pose = T[self._view[-1]]
        return np.asarray((scale * pose[:3, :3] @ self._local[-1] + pose[:3, 3])[: self._size])

    def __len__(self) -> int:
        return len(self._view)

    def keep(self, some: slice | np.ndarray) -> None:
        """Drop all others."""
        self._view, self._local = self._view[some], self._local[some]

    def away_m(self, p_w: FloatArray) -> FloatArray:
        """Distance [m] of points ``(..., size)`` from the nearest of them; infinite without any."""
        away = np.linalg.norm(np.asarray(p_w)[..., None, :] - self.p_w, axis=-1)
        return np.asarray(away.min(axis=-1, initial=np.inf))

    def is_near(self, p_w: FloatArray, away_m: float) -> bool:
        """Whether any of them is less than ``away_m`` from a point ``(size,)``."""
        return bool(self.away_m(p_w) < away_m)


def moves(before_w: FloatArray, after_w: FloatArray, least_m: float) -> bool:
    """Whether any of the views ``(N, 4, 4)`` moved by more than ``least_m``."""
    return bool((np.linalg.norm(after_w[:, :3, 3] - before_w[:, :3, 3], axis=1) > least_m).any())
