"""Depths that are free to follow noise: a camera that turns stays, one that moves goes as far as it went."""

from dataclasses import replace

import numpy as np
import pytest
from on_priors import COUNT, filmed, gone, turn
from point_map import CAMERA

from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.freed_depths import Weight, motion_priors
from edgeslam_torch.mapping.refinement import Window, refine, window_problem
from edgeslam_torch.optim.problem import LmConfig


def window_of(rng, xis):
    slam_map, keyframes, ids = filmed(rng, xis, octaves=3)
    return slam_map, keyframes, Window(keyframes[1:], keyframes[:1], ids)


@pytest.mark.parametrize("seed", range(3))
def test_a_rotation_gets_no_translation(seed):
    way = {}
    for weights in ([Weight.NONE] * 3, [Weight.WIDE, Weight.EXACT, Weight.EXACT]):
        slam_map, keyframes, window = window_of(np.random.default_rng(seed), [turn(a) for a in (0.0, 0.05, 0.1, 0.15)])
        for weight in weights:
            refine(slam_map, replace(window, freed=weight), CAMERA, LmConfig(max_iterations=30))
        way[weight] = gone(keyframes)
    assert way[Weight.NONE] > 0.03, "what depths that follow the noise make of it"
    assert way[Weight.EXACT] < 0.2 * way[Weight.NONE]


@pytest.mark.parametrize("seed", range(3))
def test_a_true_translation_is_preserved(seed):
    """A baseline of a tenth of the depth: nearly every depth is told by the images, which is no reason to move."""
    slam_map, keyframes, window = window_of(np.random.default_rng(seed), [turn(0.0), turn(0.1, 0.2), turn(0.2, 0.4)])
    refine(slam_map, window, CAMERA, LmConfig(max_iterations=30))
    before = gone(keyframes)
    refine(slam_map, replace(window, freed=Weight.EXACT), CAMERA, LmConfig(max_iterations=30))
    assert gone(keyframes) == pytest.approx(before, rel=0.02)


def test_term_is_the_information_of_the_images_on_each_depth(rng):
    """By differences of projections: t' omega t, summed over motions, is I s^2 / (1 + I s^2)^2, summed over anchors."""
    slam_map, keyframes, window = window_of(
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


def test_no_term_where_images_determine_the_depths(rng):
    slam_map, _, window = window_of(rng, [turn(0.0), turn(0.1, 0.2)])
    slam_map.anchors.from_depth[:] = False
    problem, _ = window_problem(slam_map, replace(window, freed=Weight.EXACT), CAMERA, LmConfig())
    assert problem.relative_priors == ()
