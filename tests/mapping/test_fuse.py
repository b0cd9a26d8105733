"""Looking for known anchors in keyframes that do not hold them yet."""

import numpy as np
import pytest
from point_map import CAMERA, PointMap, check_map

from edgeslam_torch.frontend.matching import words
from edgeslam_torch.mapping.fuse import fuse, fuse_all


def among_neighbours(points, keyframe):
    fuse(points.map, CAMERA, keyframe, points.map.covisible(keyframe, 12))


def in_the_whole_map(points, keyframe):
    fuse_all(points.map, CAMERA)


@pytest.mark.parametrize("join", [among_neighbours, in_the_whole_map])
def test_doubles_become_one(rng, join):
    """Half of the points got a second anchor that only the newest two keyframes know."""
    points = PointMap(rng, 300, 4)
    anchor_of = points.fill()
    keyframe, other = points.keyframes[3], points.keyframes[2]
    both = np.intersect1d(points.point_of[3], points.point_of[2])
    twice = both[anchor_of[both] >= 0][::2]
    for k in (keyframe, other):
        at = np.flatnonzero(np.isin(points.point_of[k.id], twice))
        points.map.forget_observations(k, at)
    twice = twice[points.map.anchors.alive[anchor_of[twice]]]
    ids = points.map.anchors.add(
        points.world.p_w[twice], words(points.descriptors[twice]), 3, False, np.zeros((len(twice), 3), np.uint8)
    )
    for k in (keyframe, other):
        keypoint_of = {p: i for i, p in enumerate(points.point_of[k.id])}
        points.map.observe(k, np.array([keypoint_of[p] for p in twice]), ids)
    points.map.refresh_anchors(ids)
    before = len(points.map.anchors)
    join(points, keyframe)
    check_map(points.map)
    assert before - len(points.map.anchors) > 0.8 * len(twice)


def test_forgotten_observations_are_found_again(rng):
    """Also by keyframes that share nothing any more with those that hold the anchors."""
    points = PointMap(rng, 300, 6)
    points.fill()
    last = points.keyframes[5]
    held = last.anchor.copy()
    points.map.forget_observations(last, last.keypoints_with_anchor())
    alive = (held >= 0) & points.map.anchors.alive[held]
    fuse_all(points.map, CAMERA)
    check_map(points.map)
    assert np.mean(last.anchor[alive] == held[alive]) > 0.8
    assert not np.any((last.anchor >= 0) & (last.anchor != held)), "nothing wrong beside it"
