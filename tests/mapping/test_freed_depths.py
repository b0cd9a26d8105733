"""Depths that are free to follow noise: a camera that turns stays, one that moves goes as far as it went."""

from dataclasses import replace

import numpy as np
import pytest
from point_map import CAMERA

from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.freed_depths import Weight, motion_priors
from edgeslam_torch.mapping.prior_anchors import add_on_prior, prior_of
from edgeslam_torch.mapping.refinement import Window, refine, window_problem
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.types import FrameFeatures

COUNT = 300


def filmed(rng, xis, true_sigma=0.3):
    """Keyframes at ``exp(xi)``, anchors on priors of the first one; 1 px of noise, wrong depths."""
    p = rng.uniform([-2.0, -1.5, 2.0], [2.0, 1.5, 6.0], (COUNT, 3))
    slam_map = SlamMap(1.2)
    words = rng.integers(0, 256, (COUNT, 32), dtype=np.uint8)
    keyframes = []
    for T in (se3.exp(np.asarray(xi, dtype=np.float64)) for xi in xis):
        uv = CAMERA.project(se3.transform(T, p)) + rng.normal(0.0, 1.0, (COUNT, 2))
        octave = rng.integers(0, 3, COUNT).astype(np.int32)
        features = FrameFeatures(uv.astype(np.float32), octave, np.zeros(COUNT, np.float32), words)
        id = slam_map.next_keyframe_id()
        keyframes.append(make_keyframe(id, id, float(id), T, features))
        slam_map.add_keyframe(keyframes[-1])
    z = se3.transform(keyframes[0].T_c_w, p)[:, 2]
    prior = prior_of(z * np.exp(rng.normal(0.0, true_sigma, COUNT)), np.full(COUNT, 0.5))
    colour = np.zeros((COUNT, 3), np.uint8)
    ids = add_on_prior(slam_map, CAMERA, keyframes[0], np.arange(COUNT), prior[:, 0], prior, colour)
    for keyframe in keyframes[1:]:
        slam_map.observe(keyframe, np.arange(COUNT), ids)
    return slam_map, keyframes, Window(keyframes[1:], keyframes[:1], ids)


def gone(keyframes):
    return max(float(np.linalg.norm(k.centre_w)) for k in keyframes)


def turn(angle, x=0.0):
    return [x, 0.0, 0.0, 0.0, angle, 0.0]


@pytest.mark.parametrize("seed", range(3))
def test_a_rotation_gets_no_translation(seed):
    way = {}
    for weights in ([Weight.NONE] * 3, [Weight.WIDE, Weight.EXACT, Weight.EXACT]):
        slam_map, keyframes, window = filmed(np.random.default_rng(seed), [turn(a) for a in (0.0, 0.05, 0.1, 0.15)])
        for weight in weights:
            refine(slam_map, replace(window, freed=weight), CAMERA, LmConfig(max_iterations=30))
        way[weight] = gone(keyframes)
    assert way[Weight.NONE] > 0.03, "what depths that follow the noise make of it"
    assert way[Weight.EXACT] < 0.2 * way[Weight.NONE]


@pytest.mark.parametrize("seed", range(3))
def test_a_true_translation_is_preserved(seed):
    """A baseline of a tenth of the depth: nearly every depth is told by the images, which is no reason to move."""
    slam_map, keyframes, window = filmed(np.random.default_rng(seed), [turn(0.0), turn(0.1, 0.2), turn(0.2, 0.4)])
    refine(slam_map, window, CAMERA, LmConfig(max_iterations=30))
    before = gone(keyframes)
    refine(slam_map, replace(window, freed=Weight.EXACT), CAMERA, LmConfig(max_iterations=30))
    assert gone(keyframes) == pytest.approx(before, rel=0.02)


def test_term_is_the_information_of_the_images_on_each_depth(rng):
    """By differences of projections: t' omega t, summed over motions, is I s^2 / (1 + I s^2)^2, summed over anchors."""
    slam_map, keyframes, window = filmed(
        rng, [[0.1, 0.0, 0.6, 0.0, 0.1, 0.0], turn(0.1, 0.03), [-0.02, 0.05, 0.04, 0.02, 0.0, 0.1]]
    )
    problem, _ = window_problem(slam_map, window, CAMERA, LmConfig())
    host = keyframes[0]
    p_h = se3.transform(host.T_c_w, problem.p_w)
    sigma, step = problem.depth_priors.sigma, 1e-5
    told = np.zeros(COUNT)
    for keyframe in keyframes[1:]:
        nearer = p_h / (1.0 + step * p_h[:, 2:])  # a larger inverse depth on the same ray
        uv = [CAMERA.project(se3.transform(keyframe.T_c_w @ host.T_w_c, p)) for p in (p_h, nearer)]
        level = 1.2 ** keyframe.features.octave.astype(np.float64)
        told += (((uv[1] - uv[0]) / step / level[:, None]) ** 2).sum(1)
    expected = (told * sigma**2 / (1.0 + told * sigma**2) ** 2).sum()
    total = 0.0
    for prior in motion_priors(problem, Weight.EXACT):
        t = (problem.T_c_w[prior.pose_j] @ se3.inverse(problem.T_c_w[prior.pose_i]))[:3, 3]
        assert not prior.T_j_i[:3, 3].any() and not prior.information[3:].any(), "no way expected, any turn"
        total += t @ prior.information[:3, :3] @ t
    assert total == pytest.approx(expected, rel=1e-2)


@pytest.mark.parametrize("seed", range(3))
def test_a_spurious_translation_is_removed(seed):
    """From the minimum that refinement finds without the term, whose tangent alone is too flat to leave it."""
    slam_map, keyframes, window = filmed(np.random.default_rng(seed), [turn(a) for a in (0.0, 0.05, 0.1, 0.15)])
    lm = LmConfig(max_iterations=30)
    refine(slam_map, window, CAMERA, lm)
    before = gone(keyframes)
    for weight in (Weight.WIDE, Weight.EXACT, Weight.EXACT):
        refine(slam_map, replace(window, freed=weight), CAMERA, lm)
    assert gone(keyframes) < 0.5 * before


def test_no_term_where_images_determine_the_depths(rng):
    slam_map, _, window = filmed(rng, [turn(0.0), turn(0.1, 0.2)])
    slam_map.anchors.from_depth[:] = False
    problem, _ = window_problem(slam_map, replace(window, freed=Weight.EXACT), CAMERA, LmConfig())
    assert problem.relative_priors == ()
