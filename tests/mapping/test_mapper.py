"""Taking keyframes into the map: new anchors, doubles, culling, the bound."""

import numpy as np
import pytest
from point_map import CAMERA, PointMap, check_map, filled

from edgeslam_torch.config import MappingConfig, SlamConfig
from edgeslam_torch.frontend.matching import words
from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.mapper import Mapper
from edgeslam_torch.optim.problem import LmConfig


def make_mapper(points, **mapping):
    return Mapper(points.map, CAMERA, SlamConfig(mapping=MappingConfig(**mapping)), LmConfig(diagnostics=False))


def insert(mapper, points, view, anchor_of):
    """As tracking would: with the anchors that the map already has for what the keyframe sees."""
    keyframe = points.keyframes[view]
    known = anchor_of[points.point_of[view]]
    keyframe.anchor[:] = np.where((known >= 0) & points.map.anchors.alive[known], known, -1)
    points.map.add_keyframe(keyframe)
    return mapper.insert(keyframe, np.zeros((len(keyframe.anchor), 3), np.uint8))


def anchor_errors(points):
    """Distance of every anchor to the point whose descriptor it has."""
    bits = words(points.descriptors)
    ids = np.flatnonzero(points.map.anchors.alive)
    point = [int(np.flatnonzero((bits == points.map.anchors.words[i]).all(1))[0]) for i in ids]
    return np.linalg.norm(points.map.anchors.p_w[ids] - points.world.p_w[point], axis=1), np.array(point)


def test_keyframes_build_an_exact_map(rng):
    points = PointMap(rng, 400, 6)
    anchor_of = points.fill([0, 1])
    mapper = make_mapper(points)
    before = len(points.map.anchors)
    for view in range(2, 6):
        insert(mapper, points, view, anchor_of)
        check_map(points.map)
    error, point = anchor_errors(points)
    assert len(error) > before + 20
    assert np.percentile(error, 95) < 2e-3
    assert len(np.unique(point)) == len(point), "one anchor to a point"
    xi = [se3.log(k.T_c_w @ se3.inverse(points.world.T_c_w[k.id])) for k in points.map.keyframes.values()]
    assert np.abs(xi).max() < 1e-3


@pytest.mark.parametrize("sub_pixel", [True, False])
def test_keypoints_of_a_new_keyframe_are_aligned_with_the_views_before_it(rng, sub_pixel):
    """Three cameras at one place see the same picture; the newest one's corners lie .4 px beside what it shows."""
    points = PointMap(rng, 400, 3)
    picture = np.kron(rng.integers(0, 255, (120, 160)), np.ones((4, 4))).astype(np.uint8)
    for keyframe, seen in zip(points.keyframes, points.point_of, strict=True):
        keyframe.T_c_w, keyframe.grey = points.world.T_c_w[0].copy(), picture
        keyframe.features.uv[:] = CAMERA.project(se3.transform(keyframe.T_c_w, points.world.p_w[seen]))
    anchor_of = points.fill([0, 1])
    points.keyframes[2].features.uv[:] += 0.4
    insert(make_mapper(points, sub_pixel=sub_pixel), points, 2, anchor_of)
    assert np.isfinite(points.keyframes[2].aligned_px).any() == sub_pixel


def test_new_anchors_that_are_not_found_again_are_removed(rng):
    points = PointMap(rng, 400, 3)
    anchor_of = points.fill([0, 1])
    mapper = make_mapper(points)
    old = points.map.anchors.alive.copy()
    insert(mapper, points, 2, anchor_of)
    young = np.flatnonzero(points.map.anchors.alive & ~old)
    assert len(young) > 5
    points.map.anchors.visible[young] = 20
    points.map.anchors.found[young[1:]] = 3
    points.map.anchors.found[young[0]] = 19
    mapper.cull_recent_anchors(points.keyframes[2])
    assert points.map.anchors.alive[young[0]]
    assert not points.map.anchors.alive[young[1:]].any()
    check_map(points.map)


def test_a_full_map_removes_keyframes_outside_the_window(rng, monkeypatch):
    """Thirty cameras in a row: at most twice as many as wanted stay, and the removed ones keep their place."""
    points = PointMap(rng, 300, 30)
    anchor_of = points.fill([0, 1])
    monkeypatch.setattr("edgeslam_torch.mapping.mapper.REDUNDANCY", 1.0)
    mapper = make_mapper(points, max_keyframes=12, window=5, window_fixed=5)
    for view in range(2, 30):
        before = set(points.map.keyframes)
        insert(mapper, points, view, anchor_of)
        assert len(points.map.keyframes) <= 24
        assert all(id <= view - 5 for id in before - set(points.map.keyframes))
    check_map(points.map)
    assert len(points.map.keyframes) < 30
    T = [points.map.pose_of(id) @ se3.inverse(points.world.T_c_w[id]) for id in range(30)]
    assert np.abs([se3.log(t) for t in T]).max() < 0.01


def test_the_only_views_of_a_place_are_kept_in_a_full_map(rng, monkeypatch):
    """Two cameras share a place that no other one sees; the others see what others see, too."""
    points = filled(rng, 600, 30)
    home = {0, 1}
    theirs = points.map.anchors_seen_by([points.keyframes[i] for i in home])[::2]
    for keyframe in points.keyframes:
        mine = np.isin(keyframe.anchor, theirs) == (keyframe.id in home)
        points.map.forget_observations(keyframe, np.flatnonzero(~mine & (keyframe.anchor >= 0)))
    monkeypatch.setattr("edgeslam_torch.mapping.mapper.REDUNDANCY", 1.0)
    mapper = make_mapper(points, max_keyframes=12, window=5, window_fixed=5)
    mapper.cull_keyframes(points.keyframes[-1])
    assert home <= set(points.map.keyframes) and len(points.map.keyframes) == 12
    check_map(points.map)


def test_a_map_of_unique_views_grows_to_twice_the_limit(rng, monkeypatch):
    points = filled(rng, 900, 30)
    for keyframe in points.keyframes:  # each anchor is left to two neighbours
        others = keyframe.anchor % 15 != keyframe.id // 2
        points.map.forget_observations(keyframe, np.flatnonzero((keyframe.anchor >= 0) & others))
    monkeypatch.setattr("edgeslam_torch.mapping.mapper.REDUNDANCY", 1.0)
    mapper = make_mapper(points, max_keyframes=12, window=5, window_fixed=5)
    mapper.cull_keyframes(points.keyframes[-1])
    assert len(points.map.keyframes) == 24


def test_redundant_keyframes_are_removed_except_the_first_and_last(rng, monkeypatch):
    """Every point is seen from almost everywhere: of sixteen keyframes a few would do."""
    points = PointMap(rng, 300, 16)
    anchor_of = points.fill([0, 1])
    monkeypatch.setattr("edgeslam_torch.mapping.mapper.REDUNDANCY", 0.6)
    mapper = make_mapper(points)
    for view in range(2, 16):
        insert(mapper, points, view, anchor_of)
    check_map(points.map)
    left = set(points.map.keyframes)
    assert {0, 13, 14, 15} <= left
    assert len(left) <= 10
    for id in set(range(16)) - left:
        seen = points.map.anchors_seen_by(list(points.map.keyframes.values()))
        missed = np.setdiff1d(anchor_of[points.point_of[id]], seen)
        assert len(missed[missed >= 0]) < 0.4 * len(points.point_of[id])


@pytest.mark.parametrize("settings", [{"window": 1}, {"max_keyframes": 10}, {"keyframe_parallax_deg": 0.0}])
def test_settings_out_of_range_are_rejected(settings):
    with pytest.raises(ValueError, match="must be"):
        MappingConfig(**settings)
