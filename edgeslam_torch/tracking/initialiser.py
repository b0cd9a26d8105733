"""From a map that a depth guess made to one that two views made.

The first frame gets a map at once: every keypoint at the depth that the network (or, without one, a constant)
gives it. Frames are tracked against that until one has enough parallax; then the essential matrix between the two
gives structure that owes nothing to the guess but its scale. The result is refused unless the frames in between,
which took no part in it, agree.
"""

from dataclasses import dataclass, field

import numpy as np

from edgeslam_torch.config import InitialisationConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.triangulation import bearings, triangulate
from edgeslam_torch.mapping.keyframe import Keyframe
from edgeslam_torch.optim.pose_only import refine_pose
from edgeslam_torch.tracking.relative_pose import relative_pose
from edgeslam_torch.tracking.tracker import View
from edgeslam_torch.types import FloatArray, IntArray, MotionKind


@dataclass(frozen=True, slots=True)
class BootstrapView:
    """What one frame saw of the first keyframe."""

    frame_index: int
    keypoint_uv: FloatArray
    """``(M, 2)`` in this frame."""
    inv_sigma: FloatArray
    """``(M,)``"""
    reference_keypoint: IntArray
    """``(M,)`` keypoints of the reference keyframe."""
    T_c_w: FloatArray
    """Pose against the guessed map."""


@dataclass(frozen=True, slots=True)
class TwoView:
    """Structure from the reference keyframe and the current frame; ``reason`` says why when there is none."""

    ok: bool
    reason: str
    parallax_rad: float = 0.0
    T_c_w: FloatArray = field(default_factory=lambda: np.eye(4))
    reference_keypoint: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    keypoint: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))
    p_w: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))


def two_view_map(
    reference: Keyframe,
    guess_depth: FloatArray,
    view: View,
    reference_keypoint: IntArray,
    keypoint: IntArray,
    camera: Camera,
    config: InitialisationConfig,
    seed: int = 0,
) -> TwoView:
    """Try to triangulate the matches between the reference keyframe and the current frame.

    Args:
        reference: First keyframe.
        guess_depth: ``(N,)`` depth guess at its keypoints; sets the scale through the median ratio.
        view: Current frame.
        reference_keypoint: ``(M,)`` matched keypoints of the reference.
        keypoint: ``(M,)`` their partners in the current frame.
        camera: Intrinsics.
        config: Thresholds.
        seed: Of the essential matrix's random samples.
    """
    uv_r, uv_c = reference.features.uv[reference_keypoint], view.features.uv[keypoint]
    motion = relative_pose(uv_r, uv_c, camera, min_parallax_rad=np.deg2rad(config.min_parallax_deg), seed=seed)
    if motion.kind not in (MotionKind.GENERAL, MotionKind.PLANAR):
        return TwoView(False, str(motion.kind), motion.parallax_rad)
    p_r = triangulate(bearings(uv_r, camera.K), bearings(uv_c, camera.K), motion.T_j_i)
    p_c = se3.transform(motion.T_j_i, p_r)
    with np.errstate(invalid="ignore", divide="ignore"):
        good = motion.inliers & np.isfinite(p_r).all(1) & (p_r[:, 2] > 0) & (p_c[:, 2] > 0)
        good &= np.linalg.norm(camera.project(p_r) - uv_r, axis=1) < config.max_reprojection_px
        good &= np.linalg.norm(camera.project(p_c) - uv_c, axis=1) < config.max_reprojection_px
        a, b = p_r, p_r + motion.T_j_i[:3, :3].T @ motion.T_j_i[:3, 3]
        cosine = (a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
        good &= cosine < np.cos(np.deg2rad(0.5 * config.min_parallax_deg))
    if good.sum() < config.min_points:
        return TwoView(False, f"only {int(good.sum())} points triangulate", motion.parallax_rad)
    if good.sum() < 0.6 * motion.inliers.sum():
        return TwoView(False, "most points triangulate badly", motion.parallax_rad)
    ratio = float(np.exp(np.median(np.log(guess_depth[reference_keypoint[good]] / p_r[good, 2]))))
    T_c_r = motion.T_j_i.copy()
    T_c_r[:3, 3] *= ratio
    return TwoView(
        ok=True,
        reason="",
        parallax_rad=motion.parallax_rad,
        T_c_w=T_c_r @ reference.T_c_w,
        reference_keypoint=reference_keypoint[good],
        keypoint=keypoint[good],
        p_w=se3.transform(reference.T_w_c, p_r[good] * ratio),
    )


def poses_of_witnesses(
    views: list[BootstrapView], point_of_keypoint: FloatArray, camera: Camera
) -> tuple[list[FloatArray], float]:
    """Poses of the frames in between against the new points, and the median share of matches that agree.

    Args:
        views: Frames tracked since the reference keyframe.
        point_of_keypoint: ``(N, 3)`` world point of each reference keypoint, NaN where it has none.
        camera: Intrinsics.
    """
    poses, shares = [], []
    for view in views:
        p_w = point_of_keypoint[view.reference_keypoint]
        has = np.isfinite(p_w[:, 0])
        if has.sum() < 15:
            poses.append(view.T_c_w)
            continue
        result = refine_pose(
            view.T_c_w,
            p_w[has],
            view.keypoint_uv[has].astype(np.float64),
            view.inv_sigma[has],
            (camera.fx, camera.fy, camera.cx, camera.cy),
        )
        poses.append(result.T_c_w)
        shares.append(float(result.inliers.mean()))
    return poses, float(np.median(shares)) if shares else 1.0
