"""Two-view initialisation of a map that starts with predicted depths.

The first frame creates a map: every keypoint at the depth predicted by the network (or a constant without one).
Frames are tracked against it until one has enough parallax; the essential matrix then gives structure that depends on
the prediction only by its scale. It is rejected unless the intermediate frames, which are independent of it, agree.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from edgeslam_torch.config import InitialisationConfig
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.robust_statistics import CHI2_2DOF_95
from edgeslam_torch.geometry.triangulation import bearings, triangulate
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.pose_only import refine_pose
from edgeslam_torch.optim.problem import LmConfig, ScalePrior, WindowProblem
from edgeslam_torch.tracking.relative_pose import relative_pose
from edgeslam_torch.tracking.tracker import View
from edgeslam_torch.types import FloatArray, IntArray, MotionKind

MIN_POINTS = 80
"""Minimum number of well triangulated anchors of a map."""
MAX_REPROJECTION_PX = 2.0
"""Maximum reprojection error of a triangulated anchor in either view."""


@dataclass(frozen=True, slots=True)
class BootstrapView:
    """Matches of one frame with the first keyframe."""

    frame_index: int
    keypoint_uv: FloatArray
    """``(M, 2)`` in this frame."""
    inv_sigma: FloatArray
    """``(M,)``"""
    reference_keypoint: IntArray
    """``(M,)`` keypoints of the reference keyframe."""
    T_c_w: FloatArray
    """Pose in the predicted map."""


@dataclass(frozen=True, slots=True)
class TwoView:
    """Structure from the reference keyframe and the current frame; ``reason`` explains a missing one."""

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
        guess_depth: ``(N,)`` predicted depth at its keypoints; sets the scale by the median ratio.
        view: Current frame.
        reference_keypoint: ``(M,)`` matched keypoints of the reference.
        keypoint: ``(M,)`` their partners in the current frame.
        camera: Intrinsics.
        config: Thresholds.
        seed: Seed of the essential matrix's random samples.
    """
    uv_r, uv_c = reference.features.uv[reference_keypoint], view.features.uv[keypoint]
    motion = relative_pose(uv_r, uv_c, camera, min_parallax_rad=np.deg2rad(config.min_parallax_deg), seed=seed)
    if motion.kind not in (MotionKind.GENERAL, MotionKind.PLANAR):
        return TwoView(False, str(motion.kind), motion.parallax_rad)
    p_r = triangulate(bearings(uv_r, camera.K), bearings(uv_c, camera.K), motion.T_j_i)
    p_c = se3.transform(motion.T_j_i, p_r)
    with np.errstate(invalid="ignore", divide="ignore"):
        good = motion.inliers & np.isfinite(p_r).all(1) & (p_r[:, 2] > 0) & (p_c[:, 2] > 0)
        good &= np.linalg.norm(camera.project(p_r) - uv_r, axis=1) < MAX_REPROJECTION_PX
        good &= np.linalg.norm(camera.project(p_c) - uv_c, axis=1) < MAX_REPROJECTION_PX
        a, b = p_r, p_r + motion.T_j_i[:3, :3].T @ motion.T_j_i[:3, 3]
        cosine = (a * b).sum(1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
        good &= cosine < np.cos(np.deg2rad(0.5 * config.min_parallax_deg))
    if good.sum() < MIN_POINTS:
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
    """Poses of intermediate frames against the new points, and their median share of inliers.

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


@dataclass(frozen=True, slots=True)
class Consensus:
    """Two-view structure refined over all frames that observe it."""

    two_view: TwoView
    agreeing: float
    """Share of observations within the 95 % quantile."""
    direction_sigma: float
    """Standard deviation of the newest camera's position relative to the baseline; large if rotation and translation
    are ambiguous."""
    cost: float
    """Robust cost of the refined structure, comparable for the same observations."""


def consensus(
    reference: Keyframe,
    two_view: TwoView,
    view: View,
    views: list[BootstrapView],
    poses: list[FloatArray],
    camera: Camera,
    max_views: int = 6,
) -> Consensus:
    """Refine the two views jointly with some intermediate frames, which observe the same points.

    Two views with a short baseline hardly distinguish rotation from translation, and RANSAC selects either at random;
    intermediate frames average the detector's noise, and the covariance shows whether that suffices.

    Args:
        reference: First keyframe; its pose is fixed.
        two_view: From `two_view_map`.
        view: Current frame.
        views: Intermediate frames, in order.
        poses: Their world-to-camera poses against the two-view points.
        camera: Intrinsics.
        max_views: Maximum number of intermediate frames, evenly spread.
    """
    chosen: IntArray = (
        np.unique(np.linspace(0, len(views) - 1, min(max_views, len(views))).astype(int)) if views else np.zeros(0, int)
    )
    row = np.full(len(reference.features.uv), -1, dtype=np.int64)
    row[two_view.reference_keypoint] = np.arange(len(two_view.p_w))
    pose = [np.zeros(len(two_view.p_w), dtype=np.int64)]
    anchor = [np.arange(len(two_view.p_w))]
    uv = [reference.features.uv[two_view.reference_keypoint]]
    inv_sigma = [view.inv_sigma[two_view.keypoint]]  # matches differ by at most one pyramid level
    for i, k in enumerate(chosen):
        seen = row[views[k].reference_keypoint] >= 0
        pose.append(np.full(int(seen.sum()), i + 1, dtype=np.int64))
        anchor.append(row[views[k].reference_keypoint[seen]])
        uv.append(views[k].keypoint_uv[seen])
        inv_sigma.append(views[k].inv_sigma[seen])
    newest = len(chosen) + 1
    pose.append(np.full(len(two_view.p_w), newest, dtype=np.int64))
    anchor.append(np.arange(len(two_view.p_w)))
    uv.append(view.features.uv[two_view.keypoint])
    inv_sigma.append(view.inv_sigma[two_view.keypoint])
    T_c_w = np.stack([reference.T_c_w, *(poses[k] for k in chosen), two_view.T_c_w])
    centres = se3.inverse(T_c_w)[:, :3, 3]
    baseline = float(np.linalg.norm(centres[newest] - centres[0]))
    problem = WindowProblem(
        T_c_w=T_c_w,
        pose_fixed=np.arange(newest + 1) == 0,
        p_w=two_view.p_w,
        obs_pose=np.concatenate(pose),
        obs_anchor=np.concatenate(anchor),
        uv=np.concatenate(uv).astype(np.float64),
        inv_sigma=np.concatenate(inv_sigma),
        K=(camera.fx, camera.fy, camera.cx, camera.cy),
        scale_priors=(ScalePrior(0, newest, baseline, 0.001),),
    )
    result = refine_window(problem, LmConfig(max_iterations=20, diagnostics=True))
    agreeing = result.chi2 <= CHI2_2DOF_95
    covariance = result.pose_covariance[:3, :3]
    sigma = float(np.sqrt(np.trace(covariance))) / baseline if np.isfinite(covariance).all() else np.inf
    # A point must be an inlier in the two views that become keyframes.
    count = len(two_view.p_w)
    kept = agreeing[:count] & agreeing[-count:]
    refined = replace(
        two_view,
        T_c_w=result.T_c_w[newest],
        p_w=result.p_w[kept],
        reference_keypoint=two_view.reference_keypoint[kept],
        keypoint=two_view.keypoint[kept],
    )
    return Consensus(refined, float(agreeing.mean()), sigma, result.cost_after)
