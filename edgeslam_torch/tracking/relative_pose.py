"""Two-view motion from the essential matrix, paper eqs. (2)-(5), with degenerate cases classified."""

import cv2
import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.triangulation import bearings, parallax
from edgeslam_torch.types import FloatArray, MotionKind, RelativePose

MIN_MATCHES = 15
NO_MOTION_PX = 1.0
"""Median displacement below which two views differ only by the detector's noise."""


def relative_pose(
    uv_i: FloatArray,
    uv_j: FloatArray,
    camera: Camera,
    threshold_px: float = 1.0,
    min_parallax_rad: float = 0.01,
    seed: int = 0,
) -> RelativePose:
    """Robust relative pose of matched undistorted pixels ``(M, 2)`` in two views.

    The essential matrix comes from MAGSAC++ (Barath et al., CVPR 2020). A rotation alone explains all matches by ``K
    R K^-1``, a plane by a homography.

    Args:
        uv_i: Undistorted pixels in view i.
        uv_j: The same points in view j.
        camera: Intrinsics.
        threshold_px: Inlier distance to the epipolar line.
        min_parallax_rad: Median parallax below which the translation direction is undetermined.
        seed: Seed of the random samples.
    """
    nothing = np.zeros(len(uv_i), dtype=bool)
    if len(uv_i) < MIN_MATCHES:
        return RelativePose(MotionKind.FEW_MATCHES, np.eye(4), nothing, 0.0)
    if np.median(np.linalg.norm(uv_i - uv_j, axis=1)) < NO_MOTION_PX:
        return RelativePose(MotionKind.NO_MOTION, np.eye(4), ~nothing, 0.0)
    a, b = np.ascontiguousarray(uv_i, np.float64), np.ascontiguousarray(uv_j, np.float64)
    try:
        E, mask = cv2.findEssentialMat(a, b, camera.K, camera.K, None, None, _magsac(threshold_px, seed))
    except cv2.error:  # OpenCV 5 asserts on some degenerate samples
        E = None
    if E is None or E.shape != (3, 3):
        return RelativePose(MotionKind.DEGENERATE, np.eye(4), nothing, 0.0)
    inliers = mask.ravel().astype(bool)
    if inliers.sum() < MIN_MATCHES:
        return RelativePose(MotionKind.FEW_MATCHES, np.eye(4), inliers, 0.0)
    # Cheirality (points in front of both cameras) selects one of the four decompositions.
    _, rotation, t, _ = cv2.recoverPose(E, a[inliers], b[inliers], camera.K)
    R: FloatArray = np.asarray(rotation, dtype=np.float64)
    T_j_i = np.eye(4)
    T_j_i[:3, :3], T_j_i[:3, 3] = R, t[:, 0]
    ray_i, ray_j = bearings(a[inliers], camera.K), bearings(b[inliers], camera.K)
    angle = float(np.median(parallax(ray_i, ray_j, R)))
    kind = _kind(ray_i, ray_j, a[inliers], b[inliers], angle, min_parallax_rad, threshold_px)
    return RelativePose(kind, T_j_i, inliers, angle)


def _magsac(threshold_px: float, seed: int) -> cv2.UsacParams:
    """Parameters of `cv2.USAC_MAGSAC` with a seed, because that flag ignores `cv2.setRNGSeed`."""
    parameters = cv2.UsacParams()
    parameters.randomGeneratorState = seed
    parameters.score = cv2.SCORE_METHOD_MAGSAC
    parameters.sampler = cv2.SAMPLING_UNIFORM
    parameters.loMethod = cv2.LOCAL_OPTIM_SIGMA
    parameters.loIterations, parameters.loSampleSize = 10, 20
    parameters.threshold, parameters.confidence, parameters.maxIterations = threshold_px, 0.999, 1000
    return parameters


def _kind(
    ray_i: FloatArray,
    ray_j: FloatArray,
    uv_i: FloatArray,
    uv_j: FloatArray,
    angle: float,
    min_parallax_rad: float,
    threshold_px: float,
) -> MotionKind:
    if angle < min_parallax_rad:
        return MotionKind.PURE_ROTATION
    # The best rotation (Kabsch on unit rays): if it explains the matches, the translation is undetermined.
    unit_i = ray_i / np.linalg.norm(ray_i, axis=1, keepdims=True)
    unit_j = ray_j / np.linalg.norm(ray_j, axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(unit_j.T @ unit_i)
    R = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    if float(np.median(parallax(ray_i, ray_j, R))) < 0.5 * min_parallax_rad:
        return MotionKind.PURE_ROTATION
    H, mask = cv2.findHomography(uv_i, uv_j, cv2.USAC_MAGSAC, 2.0 * threshold_px)
    if H is not None and mask.mean() > 0.9:
        return MotionKind.PLANAR
    return MotionKind.GENERAL
