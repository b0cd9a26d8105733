"""Projection of anchors into a camera and matching to its keypoints."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.frontend.matching import Matches, best_pairs, hamming
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
    p_w = anchors.p_w[ids]
    p_c = p_w @ T_c_w[:3, :3].T + T_c_w[:3, 3]
    z = np.maximum(p_c[:, 2], 1e-9)
    u = camera.fx * p_c[:, 0] / z + camera.cx
    v = camera.fy * p_c[:, 1] / z + camera.cy
    distance = np.linalg.norm(p_c, axis=1)
    ray_w = p_w + T_c_w[:3, :3].T @ T_c_w[:3, 3]
    cosine = (ray_w * anchors.normal[ids]).sum(1) / np.maximum(distance, 1e-12)
    octave = np.log(np.maximum(anchors.max_distance[ids], 1e-12) / np.maximum(distance, 1e-12)) / np.log(scale_factor)
    level = np.clip(np.rint(octave), 0, levels - 1).astype(np.int64)
    seen = (p_c[:, 2] > 1e-3 * distance) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    # ORB does not match beyond 60 degrees or two pyramid levels outside the detector's range.
    seen &= (cosine > 0.5) & (octave > -2.5) & (octave < levels + 1.5)
    return Projection(ids[seen], np.stack([u, v], axis=1)[seen], p_c[seen, 2], level[seen])


def match_projection(
    projection: Projection,
    anchor_words: NDArray[np.uint64],
    keypoint_words: NDArray[np.uint64],
    keypoint_octave: IntArray,
    grid: KeypointGrid,
    radius_px: FloatArray,
    max_hamming: int,
    ratio: float,
) -> Matches:
    """Match projected anchors (query) to keypoints (train) inside a radius ``(M,)`` each."""
    query, train = grid.near(projection.uv, radius_px)
    near_octave = np.abs(keypoint_octave[train] - projection.octave[query]) <= 1
    query, train = query[near_octave], train[near_octave]
    distance = hamming(anchor_words[query], keypoint_words[train])
    return best_pairs(query, train, distance, max_hamming, ratio)
