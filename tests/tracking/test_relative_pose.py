"""Two-view motion, and what a rotation alone leaves unexplained."""

import numpy as np
import pytest
from point_map import CAMERA
from scipy.spatial.transform import Rotation

from edgeslam_torch.geometry import se3
from edgeslam_torch.tracking.relative_pose import relative_pose, rotation_residual


def seen_by_both(rng, T_j_i, p_i, noise_px=0.0, outliers=0.0):
    """Pixels of points ``(N, 3)`` of camera i in both images, with noise and wrong matches."""
    uv = [CAMERA.project(p_i), CAMERA.project(se3.transform(T_j_i, p_i))]
    uv = [x + noise_px * rng.normal(size=x.shape) for x in uv]
    wrong = rng.random(len(p_i)) < outliers
    uv[1][wrong] = rng.uniform([0, 0], [640, 480], (int(wrong.sum()), 2))
    return (*(x.astype(np.float32) for x in uv), wrong)


def cloud(rng, n=300):
    z = rng.uniform(1.5, 6.0, n)
    return np.stack([rng.uniform(-0.8, 0.8, n) * z, rng.uniform(-0.6, 0.6, n) * z, z], axis=1)


MOTION = se3.exp(np.array([-0.4, 0.05, 0.1, 0.02, 0.08, -0.03]))


def errors_deg(found, truth):
    R = Rotation.from_matrix(found[:3, :3] @ truth[:3, :3].T).magnitude()
    a, b = found[:3, 3], truth[:3, 3]
    return np.rad2deg([R, np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1))])


def test_noise_free_motion_is_exact(rng):
    uv_i, uv_j, _ = seen_by_both(rng, MOTION, cloud(rng))
    motion = relative_pose(uv_i, uv_j, CAMERA)
    assert motion.inliers.mean() > 0.99
    assert errors_deg(motion.T_j_i, MOTION).max() < 0.01
    assert np.linalg.norm(motion.T_j_i[:3, 3]) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", range(3))
def test_motion_under_noise_and_a_third_of_wrong_matches(seed):
    rng = np.random.default_rng(seed)
    uv_i, uv_j, wrong = seen_by_both(rng, MOTION, cloud(rng), 0.5, 0.33)
    motion = relative_pose(uv_i, uv_j, CAMERA)
    rotation, direction = errors_deg(motion.T_j_i, MOTION)
    assert rotation < 0.5
    assert direction < 3.0
    assert motion.inliers[~wrong].mean() > 0.7
    assert motion.inliers[wrong].mean() < 0.1


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.03, 0.12, 0.02), (-0.1, 0.05, 0.4)])
def test_a_rotation_leaves_the_noise_alone(rng, angles, noise_px):
    """A start waits for half a degree or more; .3 px in either image at a focal length of 320 px are .08."""
    uv_i, uv_j, _ = seen_by_both(rng, se3.exp(np.r_[np.zeros(3), angles]), cloud(rng), noise_px)
    assert np.degrees(rotation_residual(uv_i, uv_j, CAMERA)) < 0.01 + 0.3 * noise_px


def test_a_rotation_leaves_the_parallax(rng):
    """It takes the mean of 0.1 / 2 and 0.1 / 4 at the two distances, either keeps half of the difference."""
    p = np.column_stack([rng.uniform(-0.3, 0.3, (200, 2)), np.repeat([2.0, 4.0], 100)])
    sideways = se3.exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    uv_i, uv_j, _ = seen_by_both(rng, sideways, p)
    assert rotation_residual(uv_i, uv_j, CAMERA) == pytest.approx(0.0125, rel=0.1)


@pytest.mark.parametrize("n", [0, 1, 14])
def test_few_matches_give_no_motion(rng, n):
    uv_i, uv_j, _ = seen_by_both(rng, MOTION, cloud(rng, n))
    motion = relative_pose(uv_i, uv_j, CAMERA)
    assert not motion.inliers.any()
    assert motion.inliers.shape == (n,)
    np.testing.assert_array_equal(motion.T_j_i, np.eye(4))


@pytest.mark.parametrize("seed", range(2))
def test_invalid_matches_give_no_motion_and_no_crash(seed):
    """Matches at random, all at one place, or on a line."""
    rng = np.random.default_rng(seed)
    anywhere = rng.uniform([0, 0], [640, 480], (2, 60, 2))
    motion = relative_pose(anywhere[0], anywhere[1], CAMERA)
    assert motion.inliers.sum() < 40
    same = relative_pose(np.full((60, 2), 100.0), np.full((60, 2), 150.0), CAMERA)
    line = relative_pose(np.linspace([0, 0], [600, 400], 60), np.linspace([10, 0], [600, 440], 60), CAMERA)
    for odd in (motion, same, line):
        assert np.isfinite(odd.T_j_i).all()
