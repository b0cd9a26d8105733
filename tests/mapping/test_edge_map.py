"""The semi-dense map: fusion in cells, agreement between keyframes, and its bound."""

import warnings

import numpy as np
import pytest
from point_map import CAMERA, edge_points, filled, small_motion

from edgeslam_torch.config import EdgeConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.edge_agreement import AGREE_PX, DEFAULT_BEND, PaintedEdges
from edgeslam_torch.mapping.edges.edge_map import EdgeMap, fuse_voxels


def test_two_points_of_one_cell_worked_by_hand():
    p = np.array([[0.001, 0.0, 0.0], [0.004, 0.0, 0.0], [0.5, 0.5, 0.5]])
    colour = np.array([[0, 0, 0], [100, 50, 0], [7, 8, 9]], np.uint8)
    cloud = fuse_voxels(p, np.array([0.02, 0.01, 0.03]), colour, np.array([2, 5, 3]), 0.01)
    # Weights 1 : 4.
    np.testing.assert_allclose(cloud.p_w, [[0.0034, 0.0, 0.0], [0.5, 0.5, 0.5]], atol=1e-6)
    assert cloud.colour.tolist() == [[80, 40, 0], [7, 8, 9]]
    np.testing.assert_allclose(cloud.sigma_m, [0.01, 0.03])
    assert cloud.observations.tolist() == [5, 3]


def host(points, id, p_w, **changes):
    return edge_points(id, se3.transform(points.map.pose_of(id), p_w), **changes)


@pytest.fixture
def points(rng):
    return filled(rng, 300, 3)


def edge_map(points, **settings):
    return EdgeMap(points.map, CAMERA, EdgeConfig(**settings))


def test_consistent_points_of_two_keyframes_count_twice(points):
    p_w = points.world.p_w[points.world.visible[0] & points.world.visible[1]][:60]
    a, b = host(points, 0, p_w), host(points, 1, p_w)
    b.p_c[:10] *= 1.2  # measured 20 % deeper: not the same point
    edges = edge_map(points)
    edges.add(b)
    edges.add(a)
    lonely = np.flatnonzero(a.observations == 1)
    assert set(range(10)) <= set(lonely)
    assert len(lonely) < 15  # another edge pixel may lie nearer by chance
    assert (b.observations[:10] == 1).all()


def test_edge_points_move_with_their_keyframe(points, rng):
    p_w = points.world.p_w[points.world.visible[0]][:50]
    slow = edge_map(points, voxel=1e-6)
    slow.hosts.append(host(points, 0, p_w, observations=np.full(50, 3, np.int32)))
    M = small_motion(rng, 0.2, 0.1)
    before = slow.points().p_w
    points.keyframes[0].T_c_w = points.keyframes[0].T_c_w @ se3.inverse(M)
    after = slow.points().p_w
    order = [np.lexsort(np.round(x, 4).T) for x in (after, se3.transform(M, before))]
    np.testing.assert_allclose(after[order[0]], se3.transform(M, before)[order[1]], atol=1e-5)


def test_only_confirmed_points_are_exported(points):
    p_w = points.world.p_w[:30]
    counts = np.r_[np.ones(10), np.full(20, 2)].astype(np.int32)
    some = edge_map(points, voxel=1e-6)
    some.hosts.append(host(points, 0, p_w, observations=counts))
    assert len(some.points().p_w) == 20
    assert edge_map(points).points().p_w.shape == (0, 3)


def test_edges_around_a_keyframe_are_confirmed_certain_and_covisible(points):
    p_w = points.world.p_w[points.world.visible[0] & points.world.visible[1]][:60]
    z = se3.transform(points.map.pose_of(1), p_w)[:, 2]
    observations = np.where(np.arange(60) < 50, 2, 1).astype(np.int32)
    sigma = np.where(np.arange(60) < 40, 0.05, 0.3) * z
    edges = edge_map(points)
    edges.hosts.append(host(points, 1, p_w, observations=observations, sigma=sigma))
    first = points.map.keyframes[0]
    np.testing.assert_allclose(edges.around(first), p_w[:40], atol=1e-9)
    first.anchor[:] = -1  # it now shares nothing with the other one
    points.map.revision += 1
    assert edges.around(first).shape == (0, 3)


def test_sigma_of_a_point_includes_map_deformation(points):
    seen = host(points, 0, points.world.p_w[points.world.visible[0]][:20], observations=np.full(20, 2, np.int32))
    some = edge_map(points, voxel=1e-6)
    some.hosts.append(seen)
    expected = np.hypot(0.01, DEFAULT_BEND * seen.p_c[:, 2])
    np.testing.assert_allclose(np.sort(some.points().sigma_m), np.sort(expected), rtol=1e-5)
    np.testing.assert_array_equal(seen.sigma, 0.01)  # the edge's own, which the solver uses, stays


def test_number_of_points_is_bounded(points):
    """Old points that one keyframe alone saw go first, then the oldest are thinned; the newest stay whole."""
    some = edge_map(points, max_points=1000)
    some.hosts.append(host(points, 0, points.world.p_w[:300]))
    some._bound()
    assert len(some.hosts.pop().uv) == 300, "below the limit nothing changes"
    for i in range(60):
        counts = np.r_[np.ones(20), np.full(10, 2)].astype(np.int32)
        some.hosts.append(host(points, i % 3, points.world.p_w[:30], observations=counts))
        some._bound()
        assert sum(len(h.uv) for h in some.hosts) <= 1000
    assert len(some.hosts[-1].uv) == len(some.hosts[-1].p_c) == 30
    assert (some.hosts[0].observations >= 2).all()
    few = edge_map(points, max_points=1)
    few.hosts += [host(points, 0, points.world.p_w[:30]) for _ in range(3)]
    few._bound()
    assert sum(len(h.uv) for h in few.hosts) <= 1


def test_the_nearest_edge_pixel_is_found_within_two_pixels(rng):
    size = (160, 120)
    edges = np.unique(rng.integers(0, size, (400, 2)), axis=0).astype(np.float32)
    uv = np.concatenate([rng.uniform(-5, 165, (2000, 2)), [[-1e7, 4.0], [159.4, 1e9]]])
    found = PaintedEdges.of(edges, size).nearest(uv)
    apart = np.linalg.norm(edges[None] - uv[:, None], axis=2)
    nearest = apart.min(axis=1)
    named = apart[np.arange(len(uv)), found]
    assert (found[nearest > AGREE_PX] == -1).all()
    assert np.mean(found[nearest <= AGREE_PX] >= 0) > 0.95
    assert (named - nearest)[found >= 0].max() < np.sqrt(2.0)  # twice what rounding moves a query
    assert np.mean(named[found >= 0] == nearest[found >= 0]) > 0.8


def test_keyframes_without_a_measured_edge_are_an_empty_map(points):
    """No median of an empty set: numpy's warning would fail the test."""
    edges = edge_map(points)
    edges.hosts.append(host(points, 0, np.zeros((0, 3))))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert edges.points().p_w.shape == (0, 3)


def test_the_same_pixel_at_another_depth_is_another_edge(points):
    """Measured by the second keyframe a fifth deeper along the first one's rays: same pixels there, another depth."""
    p_w = points.world.p_w[points.world.visible[0] & points.world.visible[1]][:60]
    centre = points.keyframes[0].centre_w
    deeper = centre + 1.2 * (p_w - centre)
    counts = []
    for theirs in (p_w, deeper):
        edges = edge_map(points)
        edges.add(host(points, 1, theirs))
        edges.add(host(points, 0, p_w))
        counts.append((edges.hosts[1].observations == 2).mean())
    assert counts[0] > 0.9
    assert counts[1] < 0.1


def followed(points, grown, on_prior=0):
    """Edges of keyframe 0 before and after its anchors have moved away from it ``grown`` times as far."""
    edges, camera = edge_map(points), points.map.keyframes[0]
    measured = host(points, 0, points.world.p_w[points.world.visible[0]][:60])
    measured.keypoint_z = edges._keypoint_z(camera)
    edges.hosts.append(measured)
    before = measured.p_c.copy()
    anchors, held = points.map.anchors, camera.anchor[camera.anchor >= 0]
    anchors.p_w[held] = camera.centre_w + grown * (anchors.p_w[held] - camera.centre_w)
    anchors.from_depth[held[on_prior:]] = on_prior > 0
    edges.follow_anchors()
    edges.follow_anchors()  # they are there already
    return before, measured


def test_edges_follow_the_anchors_of_their_keyframe(points):
    before, after = followed(points, 0.8)
    np.testing.assert_allclose(after.p_c, 0.8 * before, rtol=1e-9)
    np.testing.assert_allclose(after.sigma, 0.008, rtol=1e-9)


def test_edges_do_not_follow_a_handful_of_anchors_nor_the_network(points):
    before, after = followed(points, 0.8, on_prior=5)  # five triangulated ones are left
    np.testing.assert_array_equal(after.p_c, before)


def test_scaled_edges_keep_their_reference_depths(points):
    before, after = followed(points, 1.0)
    after.grow(2.0)
    np.testing.assert_allclose(after.p_c, 2.0 * before, rtol=1e-9)
    np.testing.assert_allclose(after.keypoint_z, 2.0 * edge_map(points)._keypoint_z(points.map.keyframes[0]))
