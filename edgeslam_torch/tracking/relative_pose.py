"""Two-view motion from the essential matrix, paper eqs. (2)-(5), and what a rotation alone leaves unexplained."""

import cv2
import numpy as np

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.triangulation import bearings, parallax
from edgeslam_torch.types import FloatArray, RelativePose

MIN_MATCHES = 15


def relative_pose(
    uv_i: FloatArray, uv_j: FloatArray, camera: Camera, threshold_px: float = 1.0, seed: int = 0
) -> RelativePose:
    """Robust relative pose of matched undistorted pixels ``(M, 2)`` in two views.

    The essential matrix comes from MAGSAC++ (Barath et al., CVPR 2020). A camera that only turns and a plane fit other
    matrices as well: `rotation_residual` shows the former.

    Args:
        uv_i: Undistorted pixels in view i.
        uv_j: The same points in view j.
        camera: Intrinsics.
        threshold_px: Inlier distance to the epipolar line.
        seed: Seed of the random samples.

    Returns:
        The motion; the identity, without inliers, if the matches are fewer than 15 or degenerate.
    """
    nothing = RelativePose(np.eye(4), np.zeros(len(uv_i), dtype=bool))
    if len(uv_i) < MIN_MATCHES:
        return nothing
    a, b = np.ascontiguousarray(uv_i, np.float64), np.ascontiguousarray(uv_j, np.float64)
    try:
        E, mask = cv2.findEssentialMat(a, b, camera.K, camera.K, None, None, _magsac(threshold_px, seed))
    except cv2.error:  # OpenCV 5 asserts on some degenerate samples
        E = None
    if E is None or E.shape != (3, 3):
        return nothing
    inliers = mask.ravel().astype(bool)
    if inliers.sum() < MIN_MATCHES:
        return nothing
    # Cheirality (points in front of both cameras) selects one of the four decompositions.
    _, R, t, _ = cv2.recoverPose(E, a[inliers], b[inliers], camera.K)
    T_j_i = np.eye(4)
    T_j_i[:3, :3], T_j_i[:3, 3] = R, t[:, 0]
    return RelativePose(T_j_i, inliers)


def rotation_residual(uv_i: FloatArray, uv_j: FloatArray, camera: Camera) -> float:
    """Median angle [rad] between matched rays that the best rotation leaves (Kabsch 1976): zero for a turning camera.

    Args:
        uv_i: Undistorted pixels ``(M, 2)`` in view i, at least one.
        uv_j: The same points in view j.
        camera: Intrinsics.
    """
    ray_i, ray_j = bearings(uv_i, camera.K), bearings(uv_j, camera.K)
    unit_i, unit_j = (ray / np.linalg.norm(ray, axis=1, keepdims=True) for ray in (ray_i, ray_j))
    u, _, vt = np.linalg.svd(unit_j.T @ unit_i)
    R_j_i = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return float(np.median(parallax(ray_i, ray_j, R_j_i)))


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
