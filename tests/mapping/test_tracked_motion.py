"""A camera that only turns, on depths that rest on priors: refinement must not take noise for a shift."""

import numpy as np
import pytest
from on_priors import filmed, gone, turn
from point_map import CAMERA

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import tracked_motion
from edgeslam_torch.mapping.refinement import Window, refine, tracked_motions
from edgeslam_torch.optim.problem import LmConfig

XIS = [turn(angle) for angle in (0.0, 0.05, 0.1, 0.15)]
SIGMA = 1e-3
"""Of a tracked motion, on all six axes."""


def refined(rng, tracked):
    slam_map, keyframes, ids = filmed(rng, XIS)
    if tracked:
        for before, keyframe in zip(keyframes[:-1], keyframes[1:], strict=True):
            keyframe.tracked = tracked_motion(before, keyframe.T_c_w, SIGMA**2 * np.eye(6))
    refine(slam_map, Window(keyframes[1:], keyframes[:1], ids), CAMERA, LmConfig(max_iterations=30))
    return keyframes


@pytest.mark.parametrize("seed", range(3))
def test_a_rotation_gets_no_translation(seed):
    alone = gone(refined(np.random.default_rng(seed), tracked=False))
    held = gone(refined(np.random.default_rng(seed), tracked=True))
    assert alone > 0.03, "what depths that follow the noise make of it"
    assert held < 0.5 * alone


def test_motion_priors_apply_while_most_depths_have_priors(rng):
    slam_map, keyframes, ids = filmed(rng, XIS)
    keyframes[2].tracked = tracked_motion(keyframes[1], keyframes[2].T_c_w, SIGMA**2 * np.eye(6))
    (prior,) = tracked_motions(slam_map, keyframes)
    assert (prior.pose_i, prior.pose_j) == (1, 2)
    np.testing.assert_allclose(prior.T_j_i, keyframes[2].T_c_w @ keyframes[1].T_w_c, atol=1e-12)
    np.testing.assert_allclose(prior.information, np.eye(6) / (3.0 * SIGMA) ** 2)
    assert tracked_motions(slam_map, keyframes[2:]) == (), "the keyframe that it was seen from is not in the window"
    slam_map.anchors.from_depth[ids[:200]] = False
    assert tracked_motions(slam_map, keyframes) == ()


@pytest.mark.parametrize("covariance", [np.full((6, 6), np.inf), np.zeros((6, 6))])
def test_a_motion_without_covariance_gives_no_prior(rng, covariance):
    _, keyframes, _ = filmed(rng, XIS)
    assert tracked_motion(keyframes[0], keyframes[1].T_c_w, covariance) is None


def test_a_motion_is_scaled_with_its_map(rng):
    """Twice the map: twice the way, and a tangent of twice the translation is as likely as before."""
    _, keyframes, _ = filmed(rng, XIS)
    T = se3.exp(np.array([0.1, 0.0, -0.2, 0.0, 0.1, 0.0]))
    motion = tracked_motion(keyframes[0], T, np.diag([0.04, 0.01, 0.09, 1e-4, 4e-4, 9e-4]))
    keyframes[1].tracked = motion
    keyframes[1].scale(2.0)
    grown = keyframes[1].tracked
    np.testing.assert_allclose(grown.T_c_r[:3, 3], 2.0 * motion.T_c_r[:3, 3])
    np.testing.assert_allclose(grown.T_c_r[:3, :3], motion.T_c_r[:3, :3])
    xi = rng.normal(size=6)
    twice = xi * np.array([2.0] * 3 + [1.0] * 3)
    assert twice @ grown.information @ twice == pytest.approx(xi @ motion.information @ xi)
