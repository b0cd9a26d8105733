"""The map's invariants hold under any sequence of operations."""

import numpy as np
import pytest
from point_map import PointMap, add_anchors, check_map, filled, small_motion

from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.types import FrameFeatures

KEYPOINTS = 40
MOVES = (
    *("add_keyframe", "add_anchors", "add_anchors", "observe", "observe", "forget"),
    *("merge", "remove_anchors", "remove_keyframe", "refresh"),
)


class Scribbler:
    """Applies random valid operations to a map."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.map = SlamMap(1.2)
        for _ in range(4):
            self.add_keyframe()

    def keyframe(self):
        return self.map.keyframes[int(self.rng.choice(sorted(self.map.keyframes)))]

    def some(self, ids, most=6):
        return self.rng.permutation(ids)[: self.rng.integers(0, most)]

    def add_keyframe(self):
        raw = self.rng.integers(0, 256, (KEYPOINTS, 32), dtype=np.uint8)
        uv = self.rng.uniform(0, 400, (KEYPOINTS, 2)).astype(np.float32)
        features = FrameFeatures(uv, np.zeros(KEYPOINTS, np.int32), np.zeros(KEYPOINTS, np.float32), raw)
        id = self.map.next_keyframe_id()
        keyframe = make_keyframe(id, id, float(id), small_motion(self.rng, 1.0, 0.3), features)
        alive = self.some(np.flatnonzero(self.map.anchors.alive), 20)
        keyframe.anchor[self.rng.permutation(KEYPOINTS)[: len(alive)]] = alive
        self.map.add_keyframe(keyframe)

    def add_anchors(self):
        self.map.anchors.begin_pass()
        n = int(self.rng.integers(0, 12))
        bits = self.rng.integers(0, 256, (n, 32), dtype=np.uint8)
        guessed = bool(self.rng.random() < 0.2)
        ids = add_anchors(self.map, self.rng.normal(size=(n, 3)), bits, max(self.map.keyframes), guessed)
        for keyframe in {k.id: k for k in (self.keyframe(), self.keyframe(), self.keyframe())}.values():
            self.observe(keyframe, ids)

    def observe(self, keyframe=None, ids=None):
        keyframe = keyframe or self.keyframe()
        ids = self.some(np.flatnonzero(self.map.anchors.alive)) if ids is None else ids
        ids = ids[~np.isin(ids, keyframe.anchor)]
        free = self.rng.permutation(np.flatnonzero(keyframe.anchor < 0))[: len(ids)]
        self.map.observe(keyframe, free, ids[: len(free)])

    def forget(self):
        keyframe = self.keyframe()
        keypoints = self.some(np.arange(KEYPOINTS), 15)  # with and without anchors
        held = keyframe.anchor[keypoints]
        self.map.forget_observations(keyframe, keypoints)
        held = held[held >= 0]
        anchors = self.map.anchors
        poor = anchors.observations[held] < 2
        assert not (poor & anchors.alive[held] & ~anchors.from_depth[held]).any()

    def merge(self):
        ids = self.rng.permutation(np.flatnonzero(self.map.anchors.alive))
        n = min(len(ids) // 2, int(self.rng.integers(0, 4)))
        seen = self.map.anchors.observations[ids[: 2 * n]].copy()
        self.map.merge_anchors(ids[:n], ids[n : 2 * n])
        assert not self.map.anchors.alive[ids[:n]].any()
        assert (self.map.anchors.observations[ids[n : 2 * n]] >= np.maximum(seen[:n], seen[n:])).all()

    def remove_anchors(self):
        self.map.remove_anchors(self.some(np.flatnonzero(self.map.anchors.alive)))

    def remove_keyframe(self):
        if len(self.map.keyframes) > 2:
            keyframe = self.keyframe()
            before = {id: self.map.pose_of(id) for id in [*self.map.keyframes, *self.map.links]}
            self.map.remove_keyframe(keyframe)
            for id, T in before.items():
                np.testing.assert_allclose(self.map.pose_of(id), T, atol=1e-9)

    def refresh(self):
        ids = np.flatnonzero(self.map.anchors.alive)
        self.map.refresh_anchors(ids)
        length = np.linalg.norm(self.map.anchors.normal[ids], axis=1)
        assert (length < 1.0 + 1e-9).all()


@pytest.mark.parametrize("seed", range(6))
def test_map_stays_consistent_under_random_changes(seed):
    scribbler = Scribbler(seed)
    moves = [getattr(Scribbler, name) for name in MOVES]
    for _ in range(120):
        moves[scribbler.rng.integers(len(moves))](scribbler)
        check_map(scribbler.map)


def test_rows_of_removed_anchors_are_reused_only_in_the_next_pass():
    anchors = SlamMap(1.2).anchors
    bits = np.zeros((3, 4), np.uint64)
    colour = np.zeros((3, 3), np.uint8)
    first = anchors.add(np.zeros((3, 3)), bits, 0, False, colour)
    anchors.remove(first)
    capacity = len(anchors.alive)
    rest = anchors.add(np.zeros((capacity, 3)), np.zeros((capacity, 4), np.uint64), 0, False, np.zeros((capacity, 3)))
    assert not np.isin(first, rest).any()
    assert len(anchors) == capacity == len(np.unique(rest))
    anchors.remove(first)  # twice changes nothing
    anchors.begin_pass()
    free = len(anchors.alive) - len(anchors)
    again = anchors.add(np.zeros((free, 3)), np.zeros((free, 4), np.uint64), 1, False, np.zeros((free, 3)))
    assert np.isin(first, again).all()
    assert anchors.alive.all()


def test_covisible_keyframes_come_by_number_of_shared_anchors(rng):
    points = filled(rng, 300, 5)
    first = points.keyframes[0]
    near = points.map.covisible(first, 10, min_shared=1)
    shared = [np.isin(k.anchor[k.anchor >= 0], first.anchor).sum() for k in near]
    assert shared == sorted(shared, reverse=True)
    assert first not in near
    assert len(points.map.covisible(first, 2, min_shared=1)) == 2
    assert points.map.covisible(first, 10, min_shared=10_000) == []
    assert points.map.anchors_seen_by([]).shape == (0,)
    np.testing.assert_array_equal(points.map.anchors_seen_by([first]), np.sort(first.anchor[first.anchor >= 0]))


def test_refreshed_anchor_has_the_direction_and_distance_of_its_cameras(rng):
    points = PointMap(rng, 100, 3)
    anchor_of = points.fill()
    point = int(np.flatnonzero(points.world.visible.all(0))[0])
    id = anchor_of[point]
    rays = np.array([points.world.p_w[point] - k.centre_w for k in points.keyframes])
    mean = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).mean(0)
    np.testing.assert_allclose(points.map.anchors.normal[id], mean / np.linalg.norm(mean), atol=1e-9)
    newest = np.linalg.norm(rays[-1])  # at octave 0
    np.testing.assert_allclose(points.map.anchors.max_distance[id], newest)


def test_a_keyframe_belongs_to_the_submap_in_which_it_was_tracked(rng):
    """Relocalised in the first piece while a second one exists: that joins nothing."""
    points = PointMap(rng, 300, 3)
    first, second, again = points.keyframes
    points.map.begin_piece("first")
    points.map.add_keyframe(first)
    ids = add_anchors(points.map, np.zeros((1, 3)), first.words[:1], guessed=True)
    points.map.observe(first, np.array([0]), ids)
    points.map.begin_piece("second")
    points.map.add_keyframe(second)
    points.map.add_keyframe(again, first)
    assert [points.map.piece_of(k.id) for k in points.keyframes] == [0, 1, 0]
    assert not points.map.join_pieces(again, [first])
    assert points.map.join_pieces(again, [second])
    assert [points.map.piece_of(k.id) for k in points.keyframes] == [0, 0, 0]


def test_frames_of_a_removed_keyframe_stay_in_their_submap(rng):
    """The keyframe next in time is of another piece, which may move without this one."""
    points = PointMap(rng, 300, 3)
    first, other, mine = points.keyframes
    points.map.begin_piece("first")
    points.map.add_keyframe(first)
    ids = add_anchors(points.map, np.zeros((1, 3)), first.words[:1], guessed=True)
    points.map.observe(first, np.array([0]), ids)
    points.map.begin_piece("second")
    points.map.add_keyframe(other)
    points.map.add_keyframe(mine, first)
    points.map.remove_keyframe(mine)
    assert points.map.links[mine.id][0] == first.id
    moved = small_motion(rng, 1.0, 0.5)
    before = points.map.pose_of(mine.id)
    other.T_c_w = other.T_c_w @ moved
    np.testing.assert_allclose(points.map.pose_of(mine.id), before)
    first.T_c_w = first.T_c_w @ moved
    np.testing.assert_allclose(points.map.pose_of(mine.id), before @ moved, atol=1e-12)


def test_the_number_of_an_empty_submap_is_reused(rng):
    points = PointMap(rng, 300, 2)
    for begun in ("dark", "still dark"):
        points.map.begin_piece(begun)
        points.map.add_keyframe(points.keyframes[points.map.piece])
    assert points.map.piece == 0


def test_an_anchor_seen_at_a_coarse_level_is_seen_at_the_finest_from_farther_off(rng):
    """Level 3 of a pyramid of 1.2: the same patch fills level 0 at 1.728 times the distance."""
    points = PointMap(rng, 100, 2)
    last = points.keyframes[1]
    last.features.octave[:] = 3
    anchor_of = points.fill()
    seen = last.keypoints_with_anchor()
    assert len(seen) > 10
    distance = np.linalg.norm(points.world.p_w[points.point_of[1][seen]] - last.centre_w, axis=1)
    np.testing.assert_allclose(points.map.anchors.max_distance[last.anchor[seen]], 1.2**3 * distance)
    assert (anchor_of[points.point_of[1][seen]] == last.anchor[seen]).all()
