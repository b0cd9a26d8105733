"""Snapshots taken while another thread maps are consistent.

The other thread comes at the worst point, between two arrays of what is read or changed. It takes the lock if it is
free and does its work then and there, so nothing here depends on time.
"""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from point_map import CAMERA, edge_points, filled

from edgeslam_torch.config import DepthConfig, EdgeConfig, SlamConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_map import EdgeMap, EdgePoints
from edgeslam_torch.slam import EdgeSlam


def beside(lock, work):
    """Do ``work`` in another thread now, unless the lock is held."""

    def attempt():
        if lock.acquire(blocking=False):
            try:
                work()
            finally:
                lock.release()

    with ThreadPoolExecutor(1) as pool:
        pool.submit(attempt).result()


@pytest.fixture
def points(rng):
    return filled(rng, 300, 3)


@pytest.fixture
def slam(points):
    """A system with a map of known points, 30 edges of each keyframe, numbered by their colour."""
    slam = EdgeSlam(CAMERA, SlamConfig(depth=DepthConfig(weights="none")))
    slam.map = points.map
    slam.edges = EdgeMap(points.map, CAMERA, EdgeConfig(voxel=1e-6))
    slam.edges.hosts += [host(points, id) for id in range(3)]
    slam.log = TrajectoryLog(points.map)
    slam.log.append(0, 0.0, 2, points.map.pose_of(2), True)  # the camera is in the piece of map that is shown
    return slam


def host(points, id, kind=EdgePoints):
    p_c = se3.transform(points.map.pose_of(id), numbered(points))
    number = np.repeat(np.arange(30, dtype=np.uint8)[:, None], 3, axis=1)
    return edge_points(id, p_c, kind=kind, colour=number, observations=np.full(30, 3, np.int32))


def numbered(points):
    """Thirty points that every keyframe sees."""
    return points.world.p_w[points.world.visible[:3].all(axis=0)][:30]


def agree(cloud, points):
    """Whether each point has the colour of its place."""
    return np.allclose(cloud.p_w, numbered(points)[cloud.colour[:, 0]], atol=1e-3)


def test_concurrent_thinning_does_not_affect_read_edges(slam, points, monkeypatch):
    pose_of = slam.map.pose_of
    thin = np.arange(30) % 2 == 0

    def meddled(id):
        if id == 1:  # the first keyframe's points are read, their sigma, colour and count are not
            beside(slam.map.lock, lambda: [h.keep(thin) for h in slam.edges.hosts if len(h.uv) == 30])
        return pose_of(id)

    monkeypatch.setattr(slam.map, "pose_of", meddled)
    assert agree(slam.edge_map(), points)


def test_concurrent_reading_never_sees_partly_thinned_edges(slam, points):
    seen = []

    class Thinned(EdgePoints):
        def keep(self, mask):
            self.uv, self.p_c = self.uv[mask], self.p_c[mask]
            beside(slam.map.lock, lambda: seen.append(slam.edge_map()))
            self.sigma, self.colour, self.observations = (x[mask] for x in (self.sigma, self.colour, self.observations))
            return int((~mask).sum())

    slam.edges = EdgeMap(points.map, CAMERA, EdgeConfig(voxel=1e-6, max_points=1000))
    slam.edges.hosts += [host(points, i % 3, Thinned) for i in range(33)]
    slam.edges.add(host(points, 0, Thinned))
    assert sum(len(h.uv) for h in slam.edges.hosts) <= 1000
    assert all(agree(cloud, points) for cloud in seen)
    assert agree(slam.edge_map(), points)


def test_concurrent_replacement_of_anchors_is_atomic(slam):
    anchors = slam.map.anchors
    alive = np.flatnonzero(anchors.alive)
    anchors.colour[alive] = 1

    def replace():
        anchors.colour[alive] = 2
        anchors.sigma[alive] = 2.0

    class Meddled(np.ndarray):
        def __getitem__(self, key):
            read = super().__getitem__(key)
            beside(slam.map.lock, replace)
            return read

    anchors.sigma[alive] = 1.0
    anchors.colour = anchors.colour.view(Meddled)
    cloud = slam.anchors()
    assert len(cloud.p_w) == len(alive) > 100
    assert np.unique(cloud.colour).tolist() == np.unique(cloud.sigma_m).tolist()


def test_concurrent_removal_of_a_keyframe_is_atomic(slam):
    last = slam.map.keyframes[2]

    class Meddled(dict):
        def __getitem__(self, id):
            if id == 0:
                beside(slam.map.lock, lambda: slam.map.remove_keyframe(last))
            return super().__getitem__(id)

    slam.map.keyframes = Meddled(slam.map.keyframes)
    assert [k.id for k in slam.keyframes()] in ([0, 1], [0, 1, 2])
