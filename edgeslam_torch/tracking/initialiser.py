"""Initialisation: the most probable motion and structure of the frames since a reference keyframe.

The first frame creates a map: every keypoint at the depth predicted by the network (or a constant without one), and
the following frames are tracked against it. A small rotation and a small translation move an image almost identically,
so the reprojection error of few frames has several minima, whose depths differ. All frames are therefore refined
jointly under the predicted depths, from tracking and from the essential matrix. The most probable result is accepted
once its covariance tells rotation from translation; then the images alone refine it, at the scale of the prediction.
"""

from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.robust_statistics import CHI2_2DOF_95
from edgeslam_torch.geometry.triangulation import bearings, parallax, triangulate
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.pose_only import refine_pose
from edgeslam_torch.optim.problem import DepthPriors, LmConfig, ScalePrior, WindowProblem
from edgeslam_torch.tracking.relative_pose import relative_pose
from edgeslam_torch.tracking.tracker import View
from edgeslam_torch.types import FloatArray, IntArray, NDArray

MIN_POINTS = 80
"""Minimum number of well triangulated anchors of a map."""

MAX_VIEWS = 6
"""Maximum number of intermediate frames in the joint refinement, evenly spread."""


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
class Structure:
    """Points on keypoints of the reference keyframe, and the pose of the newest frame, which observes them."""

    T_c_w: FloatArray
    """``(4, 4)`` world-to-camera."""
    reference_keypoint: IntArray
    """``(M,)`` keypoints of the reference."""
    keypoint: IntArray
    """``(M,)`` their partners in the newest frame."""
    p_w: FloatArray
    """``(M, 3)``"""

    def at(self, chosen: NDArray[np.bool_]) -> "Structure":
        """The chosen points ``(M,)`` alone."""
        keypoints = self.reference_keypoint[chosen], self.keypoint[chosen]
        return Structure(self.T_c_w, *keypoints, self.p_w[chosen])


@dataclass(frozen=True, slots=True)
class TwoView:
    """What the reference keyframe and the frames since say: a structure, or the reason for none."""

    reason: str
    parallax_rad: float = 0.0
    structure: Structure | None = None


def from_essential_matrix(
    reference: Keyframe, guess: Structure, view: View, camera: Camera, seed: int = 0
) -> Structure | None:
    """Motion by the essential matrix with triangulated points, paper eqs. (3) to (6); None if few triangulate.

    Args:
        reference: First keyframe.
        guess: The matches, with points at predicted depths, whose median sets the scale. Points that do not
            triangulate stay where it has them.
        view: The newest frame.
        camera: Intrinsics.
        seed: Seed of the essential matrix's random samples.
    """
    uv_r, uv_c = reference.features.uv[guess.reference_keypoint], view.features.uv[guess.keypoint]
    motion = relative_pose(uv_r, uv_c, camera, seed=seed)
    p_r = triangulate(bearings(uv_r, camera.K), bearings(uv_c, camera.K), motion.T_j_i)
    p_c = se3.transform(motion.T_j_i, p_r)
    with np.errstate(invalid="ignore"):
        good = motion.inliers & np.isfinite(p_r).all(1) & (p_r[:, 2] > 0) & (p_c[:, 2] > 0)
    if good.sum() < MIN_POINTS // 2:
        return None
    guess_r = se3.transform(reference.T_c_w, guess.p_w)
    scale = _median_ratio(guess_r[good, 2], p_r[good, 2])
    T_c_r = motion.T_j_i.copy()
    T_c_r[:3, 3] *= scale
    p_w = se3.transform(reference.T_w_c, np.where(good[:, None], p_r * scale, guess_r))
    return replace(guess, T_c_w=T_c_r @ reference.T_c_w, p_w=p_w)


def at_scale_of(reference: Keyframe, structure: Structure, depth: FloatArray) -> Structure:
    """The structure about the reference keyframe, scaled to the median of expected depths ``(M,)`` of its points."""
    p_r = se3.transform(reference.T_c_w, structure.p_w)
    scale = _median_ratio(depth, p_r[:, 2]) if len(p_r) else 1.0
    T_c_r = structure.T_c_w @ reference.T_w_c
    T_c_r[:3, 3] *= scale
    return replace(structure, T_c_w=T_c_r @ reference.T_c_w, p_w=se3.transform(reference.T_w_c, scale * p_r))


def _median_ratio(a: FloatArray, b: FloatArray) -> float:
    """Median ratio of positive numbers ``(M,)``."""
    return float(np.exp(np.median(np.log(np.maximum(a, 1e-9) / np.maximum(b, 1e-9)))))


def poses_between(views: list[BootstrapView], point_of_keypoint: FloatArray, camera: Camera) -> list[FloatArray]:
    """World-to-camera poses of intermediate frames against new points; a frame that sees few of them keeps its own.

    Args:
        views: Frames tracked since the reference keyframe.
        point_of_keypoint: ``(N, 3)`` world point of each reference keypoint, NaN where it has none.
        camera: Intrinsics.
    """
    poses = []
    for view in views:
        p_w = point_of_keypoint[view.reference_keypoint]
        has = np.isfinite(p_w[:, 0])
        if has.sum() < 15:
            poses.append(view.T_c_w)
            continue
        uv, K = view.keypoint_uv[has].astype(np.float64), (camera.fx, camera.fy, camera.cx, camera.cy)
        poses.append(refine_pose(view.T_c_w, p_w[has], uv, view.inv_sigma[has], K).T_c_w)
    return poses


@dataclass(frozen=True, slots=True)
class Consensus:
    """Structure refined over all frames that observe it."""

    structure: Structure
    """Its points that are inliers in the reference and the newest frame, which become keyframes."""
    agreeing: float
    """Share of observations within the 95 % quantile."""
    direction_sigma: float
    """Standard deviation of the newest camera's position relative to the baseline; large if rotation and translation
    are ambiguous."""
    cost: float
    """Robust cost: twice the negative log likelihood, comparable for the same observations."""


def consensus(
    reference: Keyframe,
    structure: Structure,
    view: View,
    views: list[BootstrapView],
    poses: list[FloatArray],
    camera: Camera,
    prior: FloatArray | None = None,
) -> Consensus:
    """Refine the reference and the newest frame jointly with some intermediate ones, which observe the same points.

    Args:
        reference: First keyframe; its pose is fixed.
        structure: Start.
        view: The newest frame.
        views: Intermediate frames, in order.
        poses: Start of their world-to-camera poses.
        camera: Intrinsics.
        prior: Expected inverse depth of the points in the reference and its standard deviation ``(M, 2)``, which fix
            the scale; without them the baseline keeps its length.
    """
    chosen: IntArray = (
        np.unique(np.linspace(0, len(views) - 1, min(MAX_VIEWS, len(views))).astype(int)) if views else np.zeros(0, int)
    )
    count = len(structure.p_w)
    row = np.full(len(reference.features.uv), -1, dtype=np.int64)
    row[structure.reference_keypoint] = np.arange(count)
    pose = [np.zeros(count, dtype=np.int64)]
    anchor = [np.arange(count)]
    uv = [reference.features.uv[structure.reference_keypoint]]
    inv_sigma = [view.inv_sigma[structure.keypoint]]  # matches differ by at most one pyramid level
    for i, k in enumerate(chosen):
        seen = row[views[k].reference_keypoint] >= 0
        pose.append(np.full(int(seen.sum()), i + 1, dtype=np.int64))
        anchor.append(row[views[k].reference_keypoint[seen]])
        uv.append(views[k].keypoint_uv[seen])
        inv_sigma.append(views[k].inv_sigma[seen])
    newest = len(chosen) + 1
    pose.append(np.full(count, newest, dtype=np.int64))
    anchor.append(np.arange(count))
    uv.append(view.features.uv[structure.keypoint])
    inv_sigma.append(view.inv_sigma[structure.keypoint])
    T_c_w = np.stack([reference.T_c_w, *(poses[k] for k in chosen), structure.T_c_w])
    depths = None if prior is None else DepthPriors(np.arange(count), np.zeros(count, np.int64), *prior.T)
    baseline = _baseline(T_c_w)
    problem = WindowProblem(
        T_c_w=T_c_w,
        pose_fixed=np.arange(newest + 1) == 0,
        p_w=structure.p_w,
        obs_pose=np.concatenate(pose),
        obs_anchor=np.concatenate(anchor),
        uv=np.concatenate(uv).astype(np.float64),
        inv_sigma=np.concatenate(inv_sigma),
        K=(camera.fx, camera.fy, camera.cx, camera.cy),
        scale_priors=(ScalePrior(0, newest, baseline, 0.001),) if depths is None else (),
        depth_priors=depths,
    )
    result = refine_window(problem, LmConfig(max_iterations=20, diagnostics=True))
    agreeing = result.chi2 <= CHI2_2DOF_95
    covariance = result.pose_covariance[:3, :3]
    baseline = _baseline(result.T_c_w)
    sigma = float(np.sqrt(np.trace(covariance))) / baseline if np.isfinite(covariance).all() else np.inf
    refined = replace(structure, T_c_w=result.T_c_w[newest], p_w=result.p_w)
    return Consensus(refined.at(agreeing[:count] & agreeing[-count:]), float(agreeing.mean()), sigma, result.cost_after)


def _baseline(T_c_w: FloatArray) -> float:
    """Distance of the first from the last of some cameras ``(W, 4, 4)``."""
    centres = se3.inverse(T_c_w[[0, -1]])[:, :3, 3]
    return float(np.linalg.norm(centres[1] - centres[0]))


def triangulated(structure: Structure, reference: Keyframe, min_parallax_rad: float) -> NDArray[np.bool_]:
    """Which points ``(M,)`` lie in front of both cameras and are seen under a larger parallax."""
    in_r, in_c = (se3.transform(T, structure.p_w) for T in (reference.T_c_w, structure.T_c_w))
    R_c_r = structure.T_c_w[:3, :3] @ reference.T_w_c[:3, :3]
    with np.errstate(invalid="ignore", divide="ignore"):
        angle = parallax(in_r, in_c, R_c_r)
    return np.asarray((in_r[:, 2] > 0) & (in_c[:, 2] > 0) & (angle > min_parallax_rad))
