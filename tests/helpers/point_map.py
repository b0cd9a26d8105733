"""A map whose features are exact projections of known points with descriptors of their own."""

import numpy as np
from point_world import box_room

from edgeslam_torch.frontend.matching import words
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.edges.edge_map import EdgePoints
from edgeslam_torch.types import FrameFeatures

CAMERA = Camera(640, 480, 320.0, 320.0, 319.5, 239.5)
SCALE_FACTOR = 1.2


class PointMap:
    """`box_room` seen by keyframes; ``point_of[k][i]`` is the point behind keypoint ``i`` of keyframe ``k``."""

    def __init__(self, rng, n_points=300, n_views=5, noise_px=0.0):
        self.world = box_room(rng, n_points, n_views=n_views)
        self.descriptors = rng.integers(0, 256, (n_points, 32), dtype=np.uint8)
        self.map = SlamMap(SCALE_FACTOR)
        self.point_of = []
        self.keyframes = []
        for view in range(n_views):
            seen = rng.permutation(np.flatnonzero(self.world.visible[view]))
            self.point_of.append(seen)
            features = self.features(view, seen, rng.normal(0.0, 1.0, (len(seen), 2)) * noise_px)
            id = self.map.next_keyframe_id()
            self.keyframes.append(make_keyframe(id, 10 * id, float(id), self.world.T_c_w[view], features))

    def features(self, view, points, noise=0.0):
        uv = (self.world.uv[view, points] + noise).astype(np.float32)
        n = len(points)
        return FrameFeatures(uv, np.zeros(n, np.int32), np.zeros(n, np.float32), self.descriptors[points])

    def depths(self, view):
        """True depths of a keyframe's keypoints."""
        return se3.transform(self.world.T_c_w[view], self.world.p_w)[self.point_of[view], 2]

    def fill(self, views=None):
        """Take keyframes into the map with one anchor for every point that two of them see; ids by point."""
        views = range(len(self.keyframes)) if views is None else views
        count = np.zeros(len(self.world.p_w), int)
        for v in views:
            count[self.point_of[v]] += 1
        points = np.flatnonzero(count >= 2)
        anchor_of = np.full(len(count), -1)
        anchor_of[points] = add_anchors(self.map, self.world.p_w[points], self.descriptors[points])
        for v in views:
            self.keyframes[v].anchor[:] = anchor_of[self.point_of[v]]
            self.map.add_keyframe(self.keyframes[v])
        self.map.refresh_anchors(anchor_of[points])
        return anchor_of

    def part(self, is_odd):
        """Leave a keyframe the anchors of odd numbers where ``is_odd`` of its own says so, else the even ones."""
        for keyframe in self.keyframes:
            other = np.flatnonzero((keyframe.anchor >= 0) & (keyframe.anchor % 2 != is_odd(keyframe.id)))
            self.map.forget_observations(keyframe, other)


def add_anchors(slam_map, p_w, descriptors, host=0, guessed=False):
    """Take black anchors into the map; descriptors as bytes or as words."""
    bits = words(descriptors) if descriptors.dtype == np.uint8 else descriptors
    return slam_map.anchors.add(p_w, bits, host, guessed, np.zeros((len(p_w), 3), np.uint8))


def edge_points(id, p_c, camera=CAMERA, kind=EdgePoints, **changes):
    """Black edges of a keyframe at points of its camera, across which images change along the rows."""
    n = len(p_c)
    normal = np.tile(np.float32([1.0, 0.0]), (n, 1))
    record = {"uv": camera.project(p_c).astype(np.float32), "normal": normal, "p_c": p_c, "sigma": np.full(n, 0.01)}
    record |= {"colour": np.zeros((n, 3), np.uint8), "observations": np.ones(n, np.int32)}
    return kind(id, **(record | changes))


def filled(rng, n_points=300, n_views=5, noise_px=0.0):
    """A `PointMap` whose keyframes are all in the map."""
    points = PointMap(rng, n_points, n_views, noise_px)
    points.fill()
    return points


def check_map(slam_map):
    """What must hold of any map at any time."""
    anchors = slam_map.anchors
    count = np.zeros(len(anchors.alive), int)
    for id, keyframe in slam_map.keyframes.items():
        assert keyframe.id == id
        held = keyframe.anchor[keyframe.anchor >= 0]
        assert len(np.unique(held)) == len(held), "an anchor has one keypoint in a keyframe"
        assert anchors.alive[held].all(), "no dead anchor is referred to"
        count[held] += 1
    np.testing.assert_array_equal(anchors.observations[anchors.alive], count[anchors.alive])
    assert (anchors.observations[~anchors.alive] == 0).all()
    for removed in slam_map.links:
        assert removed not in slam_map.keyframes
        assert np.isfinite(slam_map.pose_of(removed)).all()


def pose_error(T_c_w, true):
    """Lengths of the translation and of the rotation between two poses."""
    xi = se3.log(T_c_w @ se3.inverse(true))
    return np.linalg.norm(xi[:3]), np.linalg.norm(xi[3:])


def small_motion(rng, translation, rotation):
    """A random tangent's motion."""
    return se3.exp(np.r_[rng.normal(0.0, translation, 3), rng.normal(0.0, rotation, 3)])
