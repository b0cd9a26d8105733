"""Projection of anchors into a camera and matching to its keypoints."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.compiled import compiled
from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.frontend.matching import MAX_HAMMING, RATIO, Matches, best_pairs, hamming
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.types import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Projection:
    """Anchors expected in an image."""

    anchor: IntArray
    """``(M,)`` ids."""
    uv: FloatArray
    """``(M, 2)`` predicted pixels."""
    depth: FloatArray
    """``(M,)`` z-depth [map units]."""
    octave: IntArray
    """``(M,)`` predicted pyramid level."""

    def select(self, which: NDArray[np.bool_]) -> "Projection":
        """Some of the anchors."""
        return Projection(self.anchor[which], self.uv[which], self.depth[which], self.octave[which])


def project_anchors(
    anchors: Anchors, ids: IntArray, T_c_w: FloatArray, camera: Camera, scale_factor: float, levels: int
) -> Projection:
    """Anchors that are in front, inside the image, at a distance and viewing angle similar to earlier
    observations."""
    K = camera.fx, camera.fy, camera.cx, camera.cy
    size = camera.width, camera.height
    T_c_w = np.ascontiguousarray(T_c_w)
    return Projection(
        *_project(anchors.p_w, anchors.normal, anchors.max_distance, ids, T_c_w, K, size, scale_factor, levels)
    )


@compiled("f8[:,::1], f8[:,::1], f8[::1], i8[::1], f8[:,::1], UniTuple(f8, 4), UniTuple(i8, 2), f8, i8")
def _project(
    p_w: FloatArray,
    normal: FloatArray,
    max_distance: FloatArray,
    ids: IntArray,
    T_c_w: FloatArray,
    K: tuple[float, float, float, float],
    size: tuple[int, int],
    scale_factor: float,
    levels: int,
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """The fields of a `Projection`."""
    fx, fy, cx, cy = K
    anchor, level = np.empty(len(ids), np.int64), np.empty(len(ids), np.int64)
    uv, depth = np.empty((len(ids), 2)), np.empty(len(ids))
    T, seen = T_c_w, 0
    for id in ids:
        a, b, c = p_w[id]
        x = T[0, 0] * a + T[0, 1] * b + T[0, 2] * c + T[0, 3]
        y = T[1, 0] * a + T[1, 1] * b + T[1, 2] * c + T[1, 3]
        z = T[2, 0] * a + T[2, 1] * b + T[2, 2] * c + T[2, 3]
        distance = math.sqrt(x * x + y * y + z * z)
        if not z > max(1e-3 * distance, 1e-9):
            continue
        u, v = fx * x / z + cx, fy * y / z + cy
        if not (0.0 <= u < size[0] and 0.0 <= v < size[1]):
            continue
        # ORB does not match beyond 60 degrees or two pyramid levels outside the detector's range.
        p, q, r = normal[id]
        towards = x * (T[0, 0] * p + T[0, 1] * q + T[0, 2] * r) + y * (T[1, 0] * p + T[1, 1] * q + T[1, 2] * r)
        towards += z * (T[2, 0] * p + T[2, 1] * q + T[2, 2] * r)
        octave = math.log(max(max_distance[id], 1e-12) / distance) / math.log(scale_factor)
        if not (towards > 0.5 * distance and -2.5 < octave < levels + 1.5):
            continue
        anchor[seen], depth[seen] = id, z
        uv[seen, 0], uv[seen, 1] = u, v
        level[seen] = min(max(round(octave), 0), levels - 1)
        seen += 1
    return anchor[:seen], uv[:seen], depth[:seen], level[:seen]


def match_projection(
    projection: Projection,
    anchor_words: NDArray[np.uint64],
    keypoint_words: NDArray[np.uint64],
    keypoint_octave: IntArray,
    grid: KeypointGrid,
    radius_px: FloatArray,
    max_hamming: int = MAX_HAMMING,
    ratio: float = RATIO,
) -> Matches:
    """Match projected anchors (query) to keypoints (train) inside a radius ``(M,)`` each."""
    query, train = grid.near(projection.uv, radius_px)
    near_octave = np.abs(keypoint_octave[train] - projection.octave[query]) <= 1
    query, train = query[near_octave], train[near_octave]
    distance = hamming(anchor_words[query], keypoint_words[train])
    return best_pairs(query, train, distance, max_hamming, ratio)
