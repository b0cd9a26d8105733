"""Keyframes and anchors with their observations."""

import threading

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.map.keyframe import NO_ANCHOR, Keyframe
from edgeslam_torch.types import FloatArray, IntArray


class SlamMap:
    """The map that tracking reads and mapping writes.

    Removed keyframes are kept as rigid links to a surviving one, so that the pose of every frame moves with the map.
    """

    def __init__(self, scale_factor: float, levels: int = 8) -> None:
        self.scale_factor = scale_factor
        """Scale factor between pyramid levels."""
        self.levels = levels
        self.anchors = Anchors()
        self.keyframes: dict[int, Keyframe] = {}
        self.links: dict[int, tuple[int, FloatArray]] = {}
        """Removed keyframe id -> (surviving id, ``T_removed_surviving``)."""
        self.lock = threading.RLock()
        """Held to modify the map, and to read it from other threads."""
        self.revision = 0
        """Incremented with every change of observations, to invalidate caches."""
        self.begun: dict[int, str] = {}
        """Origin of the first pose and scale of each submap, by its number."""
        self._piece: dict[int, int] = {}
        """Submap in which each keyframe, alive or removed, was created."""
        self._joined: dict[int, int] = {}
        """Submap -> older submap that it was merged with."""
        self._next_id = 0

    def next_keyframe_id(self) -> int:
        """A new keyframe id."""
        self._next_id += 1
        return self._next_id - 1

    def pose_of(self, keyframe_id: int) -> FloatArray:
        """``T_c_w`` of a keyframe, alive or removed."""
        heir, T_keyframe_heir = self.resolve(keyframe_id)
        return T_keyframe_heir @ self.keyframes[heir].T_c_w

    def median_depth(self, keyframe: Keyframe) -> float | None:
        """Median depth of a keyframe's anchors [map units]; None without any in front of it."""
        observed = keyframe.anchor[keyframe.anchor >= 0]
        z = se3.transform(keyframe.T_c_w, self.anchors.p_w[observed])[:, 2]
        return float(np.median(z[z > 0])) if (z > 0).any() else None

    def resolve(self, keyframe_id: int) -> tuple[int, FloatArray]:
        """The surviving keyframe that a keyframe is linked to (itself if alive), and the transform to it."""
        chain = []
        T = np.eye(4)
        while keyframe_id in self.links:
            chain.append(keyframe_id)
            keyframe_id = self.links[keyframe_id][0]
        # Path compression: without it, a thousand links would be followed for every frame.
        for removed in reversed(chain):
            T = self.links[removed][1] @ T
            self.links[removed] = (keyframe_id, T)
        return keyframe_id, T

    # -- pieces ------------------------------------------------------------------------------------------------

    def begin_piece(self, begun: str) -> None:
        """Begin a submap for later keyframes, unless the last one has no anchor.

        Args:
            begun: Origin of the submap's first pose and scale.
        """
        members = (k for k in self.keyframes.values() if self._piece[k.id] == self.piece)
        if not self.begun or any((k.anchor != NO_ANCHOR).any() for k in members):
            self.add_piece(begun)

    def add_piece(self, begun: str) -> int:
        """Number of a new submap, unconditionally."""
        self.begun[len(self.begun)] = begun
        return len(self.begun) - 1

    @property
    def piece(self) -> int:
        """Number of the submap of new keyframes."""
        return max(len(self.begun) - 1, 0)

    def piece_of(self, keyframe_id: int) -> int:
        """Number of the present submap of a keyframe, alive or removed."""
        return self.whole(self._piece[keyframe_id])

    def whole(self, piece: int) -> int:
        """Number of the submap that a submap is part of now: its own, or of the one that it was merged with."""
        while piece in self._joined:
            piece = self._joined[piece]
        return piece

    def join_pieces(self, keyframe: Keyframe, others: list[Keyframe]) -> bool:
        """Record that a keyframe and others share anchors, hence belong to one submap; returns whether submaps were
        merged."""
        mine = self.piece_of(keyframe.id)
        found = {self.piece_of(other.id) for other in others} - {mine}
        oldest = min(found | {mine})
        for piece in (found | {mine}) - {oldest}:
            self._joined[piece] = oldest
        return bool(found)

    def scale_links(self, scale_of: dict[int, float]) -> None:
        """Rescale the links of removed keyframes to remaining ones whose surroundings were scaled, by their ids."""
        for removed in list(self.links):
            heir, T = self.resolve(removed)
            if heir in scale_of:
                self.links[removed] = (heir, se3.scaled(T, scale_of[heir]))

    def latest(self) -> Keyframe:
        """The newest keyframe."""
        with self.lock:
            return self.keyframes[max(self.keyframes)]

    # -- observations ------------------------------------------------------------------------------------------

    def observe(self, keyframe: Keyframe, keypoints: IntArray, anchors: IntArray) -> None:
        """Add observations of anchors by a keyframe's keypoints; both must be free."""
        self.revision += 1
        keyframe.anchor[keypoints] = anchors
        self.anchors.observations[anchors] += 1

    def forget_observations(self, keyframe: Keyframe, keypoints: IntArray) -> None:
        """Remove observations.

        Anchors with fewer than two observations afterwards are removed; one suffices with a depth prior.
        """
        self.revision += 1
        observed = keyframe.anchor[keypoints]
        keypoints, observed = keypoints[observed >= 0], observed[observed >= 0]
        keyframe.anchor[keypoints] = NO_ANCHOR
        self.anchors.observations[observed] -= 1
        poor = observed[self.anchors.observations[observed] < np.where(self.anchors.from_depth[observed], 1, 2)]
        self.remove_anchors(poor)

    def remove_anchors(self, ids: IntArray) -> None:
        """Remove anchors from the map and from all keyframes."""
        if len(ids) == 0:
            return
        self.revision += 1
        for keyframe, keypoints in self._keypoints_on(ids):
            keyframe.anchor[keypoints] = NO_ANCHOR
        self.anchors.observations[ids] = 0
        self.anchors.remove(ids)

    def merge_anchors(self, losers: IntArray, winners: IntArray) -> None:
        """Move all observations of ``losers`` to ``winners``, ``(M,)`` each, one-to-one and disjoint."""
        if len(losers) == 0:
            return
        target = np.full(len(self.anchors.alive), NO_ANCHOR)
        target[losers] = winners
        for keyframe, keypoints in self._keypoints_on(losers):
            new = target[keyframe.anchor[keypoints]]
            # One keypoint per anchor and keyframe; few here, for which np.isin is slow.
            already = (new[:, None] == keyframe.anchor).any(axis=1)
            keyframe.anchor[keypoints] = np.where(already, NO_ANCHOR, new)
            self.anchors.observations[new[~already]] += 1
        self.anchors.found[winners] += self.anchors.found[losers]
        self.anchors.visible[winners] += self.anchors.visible[losers]
        self.remove_anchors(losers)

    # -- covisibility ------------------------------------------------------------------------------------------

    def shared_counts(self, anchor_ids: IntArray) -> dict[int, int]:
        """Number of the given anchors that each keyframe observes; keyframes without any are omitted."""
        start, seen, _ = self._observations(anchor_ids)
        counts = np.diff(np.searchsorted(seen, start)).tolist()
        return {id: count for id, count in zip(self.keyframes, counts, strict=True) if count > 0}

    def covisible(self, keyframe: Keyframe, most: int, min_shared: int = 15) -> list[Keyframe]:
        """Other keyframes by number of shared anchors, best first."""
        counts = self.shared_counts(keyframe.anchor[keyframe.anchor >= 0])
        counts.pop(keyframe.id, None)
        ranked = sorted(counts, key=lambda id: (-counts[id], -id))
        return [self.keyframes[id] for id in ranked if counts[id] >= min_shared][:most]

    def anchors_seen_by(self, keyframes: list[Keyframe]) -> IntArray:
        """Sorted ids of anchors observed by at least one of the keyframes."""
        if not keyframes:
            return np.zeros(0, dtype=np.int64)
        seen = np.zeros(len(self.anchors.alive) + 1, dtype=bool)  # the last row answers for NO_ANCHOR
        for keyframe in keyframes:
            seen[keyframe.anchor] = True
        return np.flatnonzero(seen[:-1])

    def _observations(self, ids: IntArray) -> tuple[IntArray, IntArray, IntArray]:
        """Observations of anchors, with the keypoints of all keyframes in one row.

        Returns:
            First place of each keyframe and the end of the row ``(K + 1,)``, the places that observe one of the anchors
            ``(M,)``, ascending, and which anchors ``(M,)``.
        """
        wanted = np.zeros(len(self.anchors.alive) + 1, dtype=bool)  # the last row answers for NO_ANCHOR
        wanted[ids] = True
        wanted[-1] = False
        rows = [k.anchor for k in self.keyframes.values()]
        start = np.cumsum([0, *map(len, rows)])
        observed = np.concatenate([*rows, np.zeros(0, np.int64)])
        places = np.flatnonzero(wanted[observed])
        return start, places, observed[places]

    def _keypoints_on(self, ids: IntArray) -> list[tuple[Keyframe, IntArray]]:
        """Keyframes that observe some of the anchors, with the keypoints on them."""
        start, places, _ = self._observations(ids)
        parts = np.split(places, np.searchsorted(places, start[1:]))[:-1]
        hosts = zip(self.keyframes.values(), start[:-1].tolist(), parts, strict=True)
        return [(keyframe, part - first) for keyframe, first, part in hosts if len(part)]

    # -- keyframes ---------------------------------------------------------------------------------------------

    def add_keyframe(self, keyframe: Keyframe, reference: Keyframe | None = None) -> None:
        """Add a keyframe with its observations.

        Args:
            keyframe: The new one.
            reference: Keyframe that it was tracked against, which gives the submap; the newest submap without one.
        """
        self.revision += 1
        self.keyframes[keyframe.id] = keyframe
        self._piece[keyframe.id] = self.piece if reference is None else self._piece[reference.id]
        self.anchors.observations[keyframe.anchor[keyframe.anchor >= 0]] += 1

    def restore_keyframe(self, keyframe: Keyframe, piece: int) -> None:
        """Add a keyframe of an earlier flight, under its own id, to a submap added for it."""
        self.revision += 1
        self.keyframes[keyframe.id] = keyframe
        self._piece[keyframe.id] = piece
        self._next_id = max(self._next_id, keyframe.id + 1)
        self.anchors.observations[keyframe.anchor[keyframe.anchor >= 0]] += 1

    def restore_removed(self, id: int, heir: int, T_removed_heir: FloatArray) -> None:
        """Link a keyframe that an earlier flight removed to the surviving one ``heir``."""
        self.links[id] = (heir, T_removed_heir)
        self._piece[id] = self._piece[heir]
        self._next_id = max(self._next_id, id + 1)

    def remove_keyframe(self, keyframe: Keyframe) -> None:
        """Remove a keyframe; its frames are linked to the nearest surviving one in time."""
        self.forget_observations(keyframe, keyframe.keypoints_with_anchor())
        others = (id for id in self.keyframes if id != keyframe.id)
        # Prefer its own submap: another one may move independently.
        mine = self.piece_of(keyframe.id)
        heir = min(others, key=lambda id: (self.piece_of(id) != mine, abs(id - keyframe.id), id))
        self.links[keyframe.id] = (heir, keyframe.T_c_w @ se3.inverse(self.keyframes[heir].T_c_w))
        del self.keyframes[keyframe.id]

    def remove_empty_keyframes(self) -> None:
        """Remove keyframes without anchors, which cannot be tracked."""
        for keyframe in list(self.keyframes.values()):
            if (keyframe.anchor == NO_ANCHOR).all() and len(self.keyframes) > 1:
                self.remove_keyframe(keyframe)

    def refresh_anchors(self, ids: IntArray) -> None:
        """Recompute viewing direction, reference distance and descriptor from the observing keyframes.

        The newest observation gives descriptor and octave; the direction is the mean over all observations.
        """
        if len(ids) == 0:
            return
        keyframes = list(self.keyframes.values())
        start, seen, observed = self._observations(ids)
        host = np.repeat(np.arange(len(keyframes)), np.diff(np.searchsorted(seen, start)))
        ray = self.anchors.p_w[observed] - np.stack([k.centre_w for k in keyframes])[host]
        distance = np.sqrt(np.einsum("ij,ij->i", ray, ray))
        ray /= distance[:, None]
        total = np.stack([np.bincount(observed, ray[:, i], len(self.anchors.alive)) for i in range(3)], axis=1)[ids]
        norm = np.linalg.norm(total, axis=1)
        self.anchors.normal[ids] = total / np.where(norm > 0, norm, 1.0)[:, None]
        # Of several observations of one anchor the last assignment remains: the newest keyframe's.
        octave = np.concatenate([k.features.octave for k in keyframes])[seen]
        self.anchors.max_distance[observed] = distance * self.scale_factor**octave
        self.anchors.words[observed] = np.concatenate([k.words for k in keyframes])[seen]
