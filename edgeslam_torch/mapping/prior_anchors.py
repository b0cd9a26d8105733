"""Anchors with a depth prior, for cameras with little parallax: rotation, hover, distant scenes.

Such an anchor has a host keyframe and, along its ray, an expected inverse depth with a standard deviation, from the
depth network or from neighbouring anchors. Refinement treats it as another measurement, like that of a stereo camera;
once two keyframes see the anchor with enough parallax, the prior is dropped.
"""

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.triangulation import bearings
from edgeslam_torch.map.anchors import Anchors
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.optim.problem import DepthPriors
from edgeslam_torch.types import FloatArray, IntArray

STEPS = 4
"""Gauss-Newton steps in one variable, starting from the prior."""
MIN_SIGMA_LOG = 0.5
"""Minimum relative sigma of a predicted depth. A network compresses the depth of unseen scenes (in a hall, to a
quarter of the range of log depth), which its own sigma does not show (docs/decisions/05-first-frame.md)."""
MIN_SHARE = 0.05
"""Lower bound of the inverse depth relative to the prior's, in front of the camera."""


def inverse_depth_with_prior(
    ray: FloatArray, uv_other: FloatArray, sigma_px: FloatArray, T_o_k: FloatArray, camera: Camera, prior: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Most probable inverse depths of matched keypoints under a prior, from one other view.

    Args:
        ray: Rays ``(M, 3)`` with z = 1 in keyframe k.
        uv_other: Matched pixels ``(M, 2)`` in keyframe o.
        sigma_px: Their standard deviations ``(M,)``.
        T_o_k: ``(4, 4)``, takes coordinates of k to o.
        camera: Intrinsics.
        prior: Expected inverse z-depth in k and its standard deviation ``(M, 2)`` [1/map unit].

    Returns:
        Inverse depth and standard deviation ``(M, 2)``, and the squared whitened reprojection error in o ``(M,)``.
    """
    turned = ray @ T_o_k[:3, :3].T
    t = T_o_k[:3, 3]
    expected, sigma = prior.T
    rho = expected.copy()
    focal = np.array([camera.fx, camera.fy])
    information = 1.0 / sigma**2
    for step in range(STEPS + 1):
        p = turned + rho[:, None] * t
        z = np.maximum(p[:, 2:], 1e-6)
        r = (focal * p[:, :2] / z + [camera.cx, camera.cy] - uv_other) / sigma_px[:, None]
        if step == STEPS:
            break
        J = focal * (t[:2] - p[:, :2] / z * t[2]) / z / sigma_px[:, None]
        information = 1.0 / sigma**2 + (J * J).sum(1)
        rho = rho - ((J * r).sum(1) + (rho - expected) / sigma**2) / information
        rho = np.maximum(rho, MIN_SHARE * expected)
    return np.stack([rho, 1.0 / np.sqrt(information)], axis=1), (r * r).sum(1)


def add_on_prior(
    slam_map: SlamMap,
    camera: Camera,
    keyframe: Keyframe,
    keypoint: IntArray,
    inverse_depth: FloatArray,
    prior: FloatArray,
    colour: np.ndarray,
) -> IntArray:
    """Add anchors with depth priors on keypoints ``(M,)`` of a host keyframe, which observes them.

    Args:
        slam_map: Receives them.
        camera: Intrinsics.
        keyframe: The host, in the map.
        keypoint: Free keypoints of it.
        inverse_depth: Initial inverse depth ``(M,)`` [1/map unit].
        prior: Expected inverse depth and standard deviation ``(M, 2)``.
        colour: RGB ``(M, 3)``.

    Returns:
        Their ids ``(M,)``.
    """
    p_c = camera.back_project(keyframe.features.uv[keypoint], 1.0 / inverse_depth)
    p_w = se3.transform(keyframe.T_w_c, p_c)
    ids = slam_map.anchors.add(p_w, keyframe.words[keypoint], keyframe.id, True, colour)
    slam_map.anchors.rest_on_prior(ids, keyframe.id, keyframe.centre_w, prior)
    slam_map.observe(keyframe, keypoint, ids)
    return ids


def depth_priors(slam_map: SlamMap, anchor: IntArray, poses: list[int]) -> tuple[DepthPriors | None, list[int]]:
    """Priors of a window's anchors.

    Args:
        slam_map: Holds the anchors.
        anchor: ``(A,)`` the window's anchors.
        poses: Keyframe ids of the window's poses, in order.

    Returns:
        The priors, and the ids of hosts outside the window, whose poses follow in this order; None and no ids if no
        anchor has a prior.
    """
    row = np.flatnonzero(slam_map.anchors.from_depth[anchor])
    if len(row) == 0:
        return None, []
    host = slam_map.anchors.host[anchor[row]]
    outside = sorted(set(host.tolist()) - set(poses))
    pose_of = {id: pose for pose, id in enumerate([*poses, *outside])}
    expected, sigma = slam_map.anchors.prior[anchor[row]].T
    return DepthPriors(row, np.array([pose_of[h] for h in host.tolist()]), expected, sigma), outside


def drop_redundant_priors(slam_map: SlamMap, keyframe: Keyframe, min_parallax_rad: float) -> None:
    """Drop the priors of anchors that a keyframe observes from a different direction than their host.

    Args:
        slam_map: Holds the anchors.
        keyframe: Sees some of them.
        min_parallax_rad: Parallax from which on the images determine the depth.
    """
    anchors = slam_map.anchors
    ids = keyframe.anchor[keyframe.anchor >= 0]
    ids = ids[anchors.from_depth[ids]]
    a, b = anchors.p_w[ids] - anchors.origin[ids], anchors.p_w[ids] - keyframe.centre_w
    cosine = (a * b).sum(1) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-12)
    triangulated = ids[(cosine < np.cos(min_parallax_rad)) & (anchors.observations[ids] >= 2)]
    anchors.from_depth[triangulated] = False


def depth_slack_px(anchors: Anchors, ids: IntArray, T_c_w: FloatArray, camera: Camera) -> FloatArray | None:
    """Image uncertainty of anchors with depth priors, one sigma ``(M, 2)`` [px].

    Along the epipolar line of the host's ray; proportional to the parallax, hence zero for a rotating camera. None
    if no anchor has a prior.
    """
    unsure = np.flatnonzero(anchors.from_depth[ids])
    if len(unsure) == 0:
        return None
    slack = np.zeros((len(ids), 2))
    ids = ids[unsure]
    ray = anchors.p_w[ids] - anchors.origin[ids]
    off_c = (ray * (anchors.sigma[ids] / np.linalg.norm(ray, axis=1))[:, None]) @ T_c_w[:3, :3].T
    p_c = se3.transform(T_c_w, anchors.p_w[ids])
    z = np.maximum(p_c[:, 2:], 1e-6)
    slack[unsure] = np.array([camera.fx, camera.fy]) / z * (off_c[:, :2] - p_c[:, :2] / z * off_c[:, 2:])
    return slack


def mostly_on_priors(anchors: Anchors, ids: IntArray) -> bool:
    """Whether most of the anchors have depth priors: images then hardly distinguish rotation from translation."""
    return int(np.count_nonzero(anchors.from_depth[ids])) > 0.5 * len(ids)


def prior_of(depth: FloatArray, sigma_log: FloatArray) -> FloatArray:
    """Inverse depth and its standard deviation ``(N, 2)`` of an expected depth with a relative uncertainty."""
    return np.stack([1.0 / depth, np.maximum(sigma_log, MIN_SIGMA_LOG) / depth], axis=1)


def rays(keyframe: Keyframe, keypoint: IntArray, camera: Camera) -> FloatArray:
    """Rays ``(M, 3)`` with z = 1 of keypoints of a keyframe."""
    return bearings(keyframe.features.uv[keypoint], camera.K)
