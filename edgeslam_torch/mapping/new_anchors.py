"""Triangulate the unmatched keypoints of a new keyframe with its neighbours."""

import numpy as np

from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.frontend.matching import EMPTY, Matches, best_pairs, hamming
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.robust_statistics import CHI2_1DOF_95, CHI2_2DOF_95
from edgeslam_torch.geometry.triangulation import bearings, triangulate
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.types import FloatArray, IntArray


def epipolar_matches(
    keyframe: Keyframe,
    other: Keyframe,
    camera: Camera,
    prior_depth: FloatArray,
    prior_sigma_log: FloatArray,
    scale_factor: float,
) -> Matches:
    """Match keypoints without anchors along epipolar segments given by the depth prior.

    The prior turns the line into a segment (two sigma either way), so that few candidates are compared and repeated
    texture along the line matters less.
    """
    free = np.flatnonzero((keyframe.anchor < 0) & np.isfinite(prior_depth))
    free_there = np.flatnonzero(other.anchor < 0)
    if len(free) == 0 or len(free_there) == 0:
        return EMPTY
    T_o_k = other.T_c_w @ se3.inverse(keyframe.T_c_w)
    ray = bearings(keyframe.features.uv[free], camera.K)
    reach = np.exp(2.0 * prior_sigma_log[free])
    ends = []
    for z in (prior_depth[free] / reach, prior_depth[free] * reach):
        p_o = (ray * z[:, None]) @ T_o_k[:3, :3].T + T_o_k[:3, 3]
        ends.append((camera.project(p_o), p_o[:, 2]))
    (near, near_z), (far, far_z) = ends
    visible = (near_z > 0) & (far_z > 0)
    visible[visible] &= np.all(np.abs(near[visible]) < 4.0 * camera.width, axis=1)
    free, near, far = free[visible], near[visible], far[visible]
    if len(free) == 0:
        return EMPTY
    along = far - near
    length = np.linalg.norm(along, axis=1)
    middle = 0.5 * (near + far)
    slack = 3.0 * scale_factor ** keyframe.features.octave[free].astype(np.float64)
    # A grid of the free keypoints only: the other keyframe's grid has several times as many.
    query, train = KeypointGrid(other.features.uv[free_there]).near(middle, np.minimum(0.5 * length, 80.0) + slack)
    train = free_there[train]
    ok = np.abs(other.features.octave[train] - keyframe.features.octave[free[query]]) <= 1
    query, train = query[ok], train[ok]
    # Distance across the line in sigmas of the keypoint's level; a segment shorter than a pixel has no direction.
    direction = along / np.maximum(length, 1e-9)[:, None]
    offset = other.features.uv[train] - middle[query]
    across = offset[:, 0] * direction[query, 1] - offset[:, 1] * direction[query, 0]
    sigma = scale_factor ** other.features.octave[train].astype(np.float64)
    ok = (across**2 <= CHI2_1DOF_95 * sigma**2) | (length[query] < 1.0)
    query, train = query[ok], train[ok]
    matches = best_pairs(query, train, hamming(keyframe.words[free[query]], other.words[train]))
    return Matches(free[matches.query], matches.train, matches.distance)


def triangulate_matches(
    keyframe: Keyframe,
    other: Keyframe,
    matches: Matches,
    camera: Camera,
    scale_factor: float,
    min_parallax_rad: float,
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Triangulated matches that pass all checks.

    In front of both cameras, enough parallax, reprojection inside 95 % in both, and a distance ratio that agrees
    with the pyramid levels.

    Returns:
        Points ``(P, 3)``, their standard deviation along the ray ``(P,)``, and the indices ``(P,)`` of the matches
        they come from.
    """
    if len(matches) == 0:
        return np.zeros((0, 3)), np.zeros(0), EMPTY.query
    K = camera.K
    uv_k, uv_o = keyframe.features.uv[matches.query], other.features.uv[matches.train]
    T_o_k = other.T_c_w @ se3.inverse(keyframe.T_c_w)
    ray_k, ray_o = bearings(uv_k, K), bearings(uv_o, K)
    p_k = triangulate(ray_k, ray_o, T_o_k)
    p_o = se3.transform(T_o_k, p_k)
    sigma_k = scale_factor ** keyframe.features.octave[matches.query].astype(np.float64)
    sigma_o = scale_factor ** other.features.octave[matches.train].astype(np.float64)
    d_k, d_o = np.linalg.norm(p_k, axis=1), np.linalg.norm(p_o, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = ((p_k @ T_o_k[:3, :3].T) * p_o).sum(1) / (d_k * d_o)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        ok = np.isfinite(p_k).all(1) & (p_k[:, 2] > 0) & (p_o[:, 2] > 0) & (angle > min_parallax_rad)
        ok &= ((camera.project(p_k) - uv_k) ** 2).sum(1) <= CHI2_2DOF_95 * sigma_k**2
        ok &= ((camera.project(p_o) - uv_o) ** 2).sum(1) <= CHI2_2DOF_95 * sigma_o**2
        level_ratio = sigma_o / sigma_k * d_o / d_k  # 1 when a patch has the same size in both pyramid levels
        ok &= (level_ratio < 1.5 * scale_factor) & (level_ratio > 1.0 / (1.5 * scale_factor))
    ok = np.flatnonzero(ok)
    sigma_depth = d_k[ok] * np.maximum(sigma_k[ok], sigma_o[ok]) / (camera.fx * np.maximum(angle[ok], 1e-6))
    return se3.transform(keyframe.T_w_c, p_k[ok]), sigma_depth, ok
