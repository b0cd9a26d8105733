"""Looking for known anchors in keyframes that do not hold them yet."""

from dataclasses import replace

import numpy as np
import pytest
from point_map import CAMERA, PointMap, add_anchors, check_map, filled

from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.mapping.fuse import fuse_all, fuse_new, merge


def among_neighbours(points, keyframe):
    fuse_new(points.map, CAMERA, keyframe, points.map.covisible(keyframe, 12))


def in_the_whole_map(points, keyframe):
    fuse_all(points.map, CAMERA)


@pytest.mark.parametrize("join", [among_neighbours, in_the_whole_map])
def test_duplicates_are_merged(rng, join):
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
    ids = add_anchors(points.map, points.world.p_w[twice], points.descriptors[twice], 3)
    for k in (keyframe, other):
        keypoint_of = {p: i for i, p in enumerate(points.point_of[k.id])}
        points.map.observe(k, np.array([keypoint_of[p] for p in twice]), ids)
    points.map.refresh_anchors(ids)
    before = len(points.map.anchors)
    join(points, keyframe)
    check_map(points.map)
    assert before - len(points.map.anchors) > 0.8 * len(twice)


def test_of_duplicates_the_better_observed_anchor_is_kept(rng):
    points = PointMap(rng, 200, 5)
    anchor_of = points.fill()
    observations = points.map.anchors.observations
    well = anchor_of[(anchor_of >= 0)]
    well = well[observations[well] >= 4][:20]
    doubles = add_anchors(points.map, points.map.anchors.p_w[well], points.map.anchors.words[well], 4)
    half = len(well) // 2
    pairs = [(well[:half], doubles[:half]), (doubles[half:], well[half:])]  # whichever of the two is named first
    merge(points.map, pairs)
    assert points.map.anchors.alive[well].all()
    assert not points.map.anchors.alive[doubles].any()
    check_map(points.map)


@pytest.mark.parametrize(("off_px", "least", "most"), [(0.0, 0.8, 1.0), (2.2, 0.5, 1.0), (2.8, 0.0, 0.0)])
def test_missing_observations_are_found_up_to_the_95_percent_quantile(rng, off_px, least, most):
    """Of two degrees of freedom: 2.45 px. Also by keyframes that share nothing any more with those that hold them."""
    points = filled(rng, 300, 6)
    last = points.keyframes[5]
    held = last.anchor.copy()
    points.map.forget_observations(last, last.keypoints_with_anchor())
    alive = (held >= 0) & points.map.anchors.alive[held]
    shifted = last.features.uv + np.float32([off_px, 0.0])
    last.features = replace(last.features, uv=shifted)
    last.grid = KeypointGrid(shifted)
    fuse_all(points.map, CAMERA)
    check_map(points.map)
    assert least <= np.mean(last.anchor[alive] == held[alive]) <= most
    wrong = (last.anchor >= 0) & (last.anchor != held)
    assert wrong.mean() <= (0.05 if off_px else 0.0)
