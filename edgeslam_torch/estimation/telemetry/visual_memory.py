"""Visual poses of the last minutes at about 10 Hz, and displacements over half seconds."""

import math
from collections import deque
from collections.abc import Callable, Collection
from copy import copy
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray

_SIGHTING_S = 0.09
"""Minimum time between stored poses: telemetry comes every 0.1 s."""
_MANY_DISPLACEMENTS = 16
"""Number of displacements from which on pairs are merged to intervals of a second."""


@dataclass(frozen=True, slots=True)
class VisualPose:
    """One tracked frame in the map's own gauge."""

    stamp_s: float
    T: FloatArray
    """``(4, 4)`` camera to map [map units]."""
    sigma_t: float
    """Standard deviation of the translation per axis [map units]."""
    sigma_r_rad: float
    piece: int = 0
    """Number of its submap."""

    def moved(self, T: FloatArray) -> "VisualPose":
        """The pose in a map transformed by ``T`` ``(4, 4)``."""
        return replace(self, T=T @ self.T)

    def revised(self, known: dict[float, FloatArray]) -> "VisualPose":
        """The refined pose of this frame, if there is one."""
        T = known.get(self.stamp_s)
        return self if T is None else replace(self, T=T)


@dataclass(frozen=True, slots=True)
class Displacements:
    """Visual motion over disjoint intervals; ``N`` of them."""

    from_s: FloatArray
    """``(N,)``"""
    to_s: FloatArray
    """``(N,)``"""
    moved: FloatArray
    """``(N, 3)`` [map units], map axes."""
    sigma: FloatArray
    """``(N,)`` standard deviation of ``moved`` per axis [map units]."""
    R_from: FloatArray
    """``(N, 3, 3)`` camera to map at the start."""
    R_to: FloatArray
    """``(N, 3, 3)`` and at the end."""

    def __len__(self) -> int:
        return len(self.from_s)

    @property
    def duration_s(self) -> FloatArray:
        """``(N,)``"""
        return self.to_s - self.from_s

    def only(self, use: NDArray[np.bool_]) -> "Displacements":
        """The selected intervals."""
        fields = (self.from_s, self.to_s, self.moved, self.sigma, self.R_from, self.R_to)
        return Displacements(*(x[use] for x in fields))

    def on_telemetry_clock(self, delay_s: float) -> "Displacements":
        """The same intervals on telemetry's clock, for a video delay of ``delay_s``."""
        return replace(self, from_s=self.from_s - delay_s, to_s=self.to_s - delay_s)

    def joined(self) -> "Displacements":
        """Neighbours merged in pairs once there are many.

        Over half a second map errors are a tenth of the displacement and more, and noise in the regressor biases the
        scale towards zero; over a second they have hardly grown, and the displacement has doubled.
        """
        if len(self) < _MANY_DISPLACEMENTS:
            return self
        touches = np.append(np.abs(self.from_s[1:] - self.to_s[:-1]) < 1e-6, False)
        first, k = [], 0
        while k < len(self):
            first.append(k)
            k += 2 if touches[k] else 1
        i = np.array(first)
        j = i + touches[i]
        whole = self.moved[i] + touches[i, None] * self.moved[j]
        sigma = np.maximum(self.sigma[i], self.sigma[j])
        return Displacements(self.from_s[i], self.to_s[j], whole, sigma, self.R_from[i], self.R_to[j])


@dataclass(frozen=True, slots=True)
class Sightings:
    """Tracked poses at about 10 Hz; ``S`` of them."""

    stamps_s: FloatArray
    """``(S,)``"""
    T: FloatArray
    """``(S, 4, 4)`` camera to map [map units]."""
    sigma_t: FloatArray
    """``(S,)``"""


class VisualMemory:
    """Poses of tracked frames, in the map's gauge.

    Args:
        interval_s: Length of one displacement.
        window_s: Maximum age.
        max_gap_s: Gap in tracking that ends a displacement.
    """

    def __init__(self, interval_s: float, window_s: float, max_gap_s: float) -> None:
        self._interval_s, self._max_gap_s = interval_s, max_gap_s
        self._sightings: deque[VisualPose] = deque(maxlen=int(10 * window_s))
        self._unbroken: deque[bool] = deque(maxlen=int(10 * window_s))
        """Whether tracking has not been interrupted between each pose and the one before."""
        self._interrupted = True
        self.began_s = math.inf
        """Stamp of the first tracked frame."""
        self.piece = 0
        """Number of the camera's submap."""
        self.R_w_piece: dict[int, FloatArray] = {}
        """``(3, 3)`` axes of submaps to the drone's world, by their numbers: each begins at a predicted heading."""
        self.last: VisualPose | None = None
        """Newest tracked frame."""
        self.previous: VisualPose | None = None
        """The one before, if tracking has not been interrupted since."""
        self._displacements: Displacements | None = None
        self._shown: Sightings | None = None

    def add(self, visual: VisualPose) -> None:
        """Add a tracked frame, newer than all before."""
        last = self.last
        self.began_s = min(self.began_s, visual.stamp_s)
        gap = last is None or visual.stamp_s - last.stamp_s > self._max_gap_s
        self.previous, self.last = None if gap else last, visual
        self._interrupted |= gap
        if not self._sightings or visual.stamp_s - self._sightings[-1].stamp_s > _SIGHTING_S:
            self._sightings.append(visual)
            self._unbroken.append(not self._interrupted)
            self._interrupted = False
            self._shown = self._displacements = None

    def of(self, pieces: Collection[int]) -> "VisualMemory":
        """A copy with the frames of some submaps alone."""
        other, kept = copy(self), [k for k, v in enumerate(self._sightings) if v.piece in pieces]
        other._sightings = deque((self._sightings[k] for k in kept), self._sightings.maxlen)
        other._unbroken = deque((self._unbroken[k] for k in kept), self._unbroken.maxlen)
        other._shown = other._displacements = None
        return other

    @property
    def pieces(self) -> set[int]:
        """Numbers of the submaps of the stored poses, and of the camera's."""
        return {v.piece for v in self._sightings} | {self.piece}

    def enter(self, piece: int) -> None:
        """The camera is in a submap from now on."""
        if piece != self.piece:
            self.piece = piece
            self.interrupt()
            self._shown = self._displacements = None

    def join(self, piece_of: Callable[[int], int]) -> None:
        """Submaps were merged: ``piece_of`` returns the present number of each."""
        self._sightings = deque((replace(v, piece=piece_of(v.piece)) for v in self._sightings), self._sightings.maxlen)
        self.piece = piece_of(self.piece)
        self._shown = self._displacements = None

    def interrupt(self) -> None:
        """End the current displacement: tracking was lost."""
        self._interrupted, self.previous = True, None

    def revise(self, stamps_s: FloatArray, T_w_c: FloatArray) -> None:
        """Replace poses by refined ones ``(F, 4, 4)`` with stamps ``(F,)``; others are unchanged."""
        known = dict(zip(stamps_s.tolist(), T_w_c, strict=True))
        self._sightings = deque((v.revised(known) for v in self._sightings), self._sightings.maxlen)
        self.last, self.previous = (None if v is None else v.revised(known) for v in (self.last, self.previous))
        self._shown = self._displacements = None

    def move_newest(self, T: FloatArray) -> None:
        """Transform the newest poses with the map around them: ``T_w_c' = T T_w_c``, ``(4, 4)``; older ones are
        unchanged."""
        self.last, self.previous = (None if v is None else v.moved(T) for v in (self.last, self.previous))

    @property
    def count(self) -> int:
        """Number of displacements."""
        return len(self.displacements())

    @property
    def length_s(self) -> float:
        """Time from the oldest to the newest stored pose."""
        return self.last.stamp_s - self._sightings[0].stamp_s if self.last is not None else 0.0

    def displacements(self) -> Displacements:
        """All displacements as arrays."""
        if self._displacements is None:
            seen, ends = self.sightings(), []
            begin, stamps_s = 0, seen.stamps_s.tolist()
            for k, unbroken in enumerate(self._unbroken):
                if not unbroken:
                    begin = k
                elif stamps_s[k] - stamps_s[begin] >= self._interval_s - 1e-3:
                    ends.append((begin, k))
                    begin = k
            i, j = np.array(ends, dtype=np.int64).reshape(-1, 2).T
            moved, sigma = seen.T[j, :3, 3] - seen.T[i, :3, 3], np.hypot(seen.sigma_t[i], seen.sigma_t[j])
            R = seen.T[:, :3, :3]
            self._displacements = Displacements(seen.stamps_s[i], seen.stamps_s[j], moved, sigma, R[i], R[j])
        return self._displacements

    def newest(self, count: int | None = None) -> Sightings:
        """The newest poses of the present submap in order, at most ``count``, as arrays."""
        return self._arrays([v for v in islice(reversed(self._sightings), count) if v.piece == self.piece][::-1])

    def sightings(self) -> Sightings:
        """All poses as arrays, in the axes of the camera's submap where those of theirs are known."""
        if self._shown is None:
            self._shown = self._arrays(self._sightings)
        return self._shown

    def _arrays(self, poses: Collection[VisualPose]) -> Sightings:
        T = np.array([v.T for v in poses]).reshape(-1, 4, 4)
        piece, R_w_here = np.array([v.piece for v in poses]), self.R_w_piece.get(self.piece)
        for other in set(piece.tolist()) & self.R_w_piece.keys() - {self.piece}:
            if R_w_here is not None:
                there = piece == other
                T[there, :3] = R_w_here.T @ self.R_w_piece[other] @ T[there, :3]
        return Sightings(np.array([v.stamp_s for v in poses]), T, np.array([v.sigma_t for v in poses]))
