"""Keyframes whose anchors rest on wrong predicted depths."""

import numpy as np
from point_map import CAMERA

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.prior_anchors import add_on_prior, prior_of
from edgeslam_torch.types import FrameFeatures

COUNT = 300


def filmed(rng, xis, octaves=1):
    """Map, keyframes at ``exp(xi)`` and ids of anchors on priors of the first one; 1 px of noise, depths 30 % off."""
    p = rng.uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 6.0], (COUNT, 3))
    slam_map = SlamMap(1.2)
    descriptors = rng.integers(0, 256, (COUNT, 32), dtype=np.uint8)
    keyframes = []
    for T in (se3.exp(np.asarray(xi, dtype=np.float64)) for xi in xis):
        uv = CAMERA.project(se3.transform(T, p)) + rng.normal(0.0, 1.0, (COUNT, 2))
        octave = rng.integers(0, octaves, COUNT).astype(np.int32)
        features = FrameFeatures(uv.astype(np.float32), octave, np.zeros(COUNT, np.float32), descriptors)
        id = slam_map.next_keyframe_id()
        keyframes.append(make_keyframe(id, id, float(id), T, features))
        slam_map.add_keyframe(keyframes[-1])
    z = se3.transform(keyframes[0].T_c_w, p)[:, 2]
    prior = prior_of(z * np.exp(rng.normal(0.0, 0.3, COUNT)), np.full(COUNT, 0.5))
    colour = np.zeros((COUNT, 3), np.uint8)
    ids = add_on_prior(slam_map, CAMERA, keyframes[0], np.arange(COUNT), prior[:, 0], prior, colour)
    for keyframe in keyframes[1:]:
        slam_map.observe(keyframe, np.arange(COUNT), ids)
    return slam_map, keyframes, ids


def gone(keyframes):
    """Distance of the farthest camera from the origin."""
    return max(float(np.linalg.norm(k.centre_w)) for k in keyframes)


def turn(angle, x=0.0):
    """Tangent of a turn about y after a step along x."""
    return [x, 0.0, 0.0, 0.0, angle, 0.0]
