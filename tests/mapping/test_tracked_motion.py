"""A camera that only turns, on depths that rest on priors: refinement must not take noise for a shift."""

import numpy as np
import pytest
from point_map import CAMERA

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import make_keyframe, tracked_motion
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.prior_anchors import add_on_prior, prior_of
from edgeslam_torch.mapping.refinement import Window, refine, tracked_motions
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.types import FrameFeatures

TURNS = [se3.exp(np.array([0.0, 0.0, 0.0, 0.0, angle, 0.0])) for angle in (0.0, 0.05, 0.1, 0.15)]
SIGMA = 1e-3
"""Of a tracked motion, on all six axes."""


def turning(rng):
    """Keyframes that turn on the spot; 1 px of noise, wrong depths."""
    p = rng.uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 6.0], (300, 3))
    slam_map = SlamMap(1.2)
    descriptors = rng.integers(0, 256, (300, 32), dtype=np.uint8)
    keyframes = []
    for T in TURNS:
        uv = CAMERA.project(se3.transform(T, p)) + rng.normal(0.0, 1.0, (300, 2))
        features = FrameFeatures(uv.astype(np.float32), np.zeros(300, np.int32), np.zeros(300, np.float32), descriptors)
        id = slam_map.next_keyframe_id()
        keyframe = make_keyframe(id, id, float(id), T, features)
        slam_map.add_keyframe(keyframe)
        keyframes.append(keyframe)
    prior = prior_of(p[:, 2] * np.exp(rng.normal(0.0, 0.3, 300)), np.full(300, 0.5))
    colour = np.zeros((300, 3), np.uint8)
    ids = add_on_prior(slam_map, CAMERA, keyframes[0], np.arange(300), prior[:, 0], prior, colour)
    for keyframe in keyframes[1:]:
        slam_map.observe(keyframe, np.arange(300), ids)
    return slam_map, keyframes, ids


def shift(keyframes):
    return max(float(np.linalg.norm(k.centre_w)) for k in keyframes)


def refined(rng, tracked):
    slam_map, keyframes, ids = turning(rng)
    if tracked:
        for before, keyframe in zip(keyframes[:-1], keyframes[1:], strict=True):
            keyframe.tracked = tracked_motion(before, keyframe.T_c_w, SIGMA**2 * np.eye(6))
    refine(slam_map, Window(keyframes[1:], keyframes[:1], ids), CAMERA, LmConfig(max_iterations=30))
    return keyframes


@pytest.mark.parametrize("seed", range(3))
def test_a_rotation_gets_no_translation(seed):
    alone = shift(refined(np.random.default_rng(seed), tracked=False))
    held = shift(refined(np.random.default_rng(seed), tracked=True))
    assert alone > 0.03, "what depths that follow the noise make of it"
    assert held < 0.5 * alone


def test_motion_priors_apply_while_most_depths_have_priors(rng):
    slam_map, keyframes, ids = turning(rng)
    keyframes[2].tracked = tracked_motion(keyframes[1], keyframes[2].T_c_w, SIGMA**2 * np.eye(6))
    (prior,) = tracked_motions(slam_map, keyframes)
    assert (prior.pose_i, prior.pose_j) == (1, 2)
    np.testing.assert_allclose(prior.T_j_i, TURNS[2] @ se3.inverse(TURNS[1]), atol=1e-12)
    np.testing.assert_allclose(prior.information, np.eye(6) / (3.0 * SIGMA) ** 2)
    assert tracked_motions(slam_map, keyframes[2:]) == (), "the keyframe that it was seen from is not in the window"
    slam_map.anchors.from_depth[ids[:200]] = False
    assert tracked_motions(slam_map, keyframes) == ()


@pytest.mark.parametrize("covariance", [np.full((6, 6), np.inf), np.zeros((6, 6))])
def test_a_motion_without_covariance_gives_no_prior(rng, covariance):
    _, keyframes, _ = turning(rng)
    assert tracked_motion(keyframes[0], keyframes[1].T_c_w, covariance) is None


def test_a_motion_is_scaled_with_its_map(rng):
    """Twice the map: twice the way, and a tangent of twice the translation is as likely as before."""
    _, keyframes, _ = turning(rng)
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
