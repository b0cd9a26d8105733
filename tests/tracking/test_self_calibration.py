"""Focal length of an unknown camera."""

from dataclasses import replace

import numpy as np
import pytest
from rendered import film, stairs_world

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import GUESSED_FOCAL_SIGMA, Camera
from edgeslam_torch.map.keyframe import make_keyframe
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.tracking.self_calibration import (
    FocalEstimate,
    _map_problem,
    calibration_warning,
    contradicts,
    focal_from_map,
    focal_from_matches,
    focal_of,
    guess_camera,
)
from edgeslam_torch.types import FrameFeatures

WIDTH, HEIGHT = 640, 480


def cloud(rng, n=250):
    z = rng.uniform(1.5, 6.0, n)
    return np.stack([rng.uniform(-0.6, 0.6, n) * z, rng.uniform(-0.45, 0.45, n) * z, z], axis=1)


def pair(rng, focal, T_j_i, p_i, noise_px=0.0):
    """Matches of points seen by a camera with its principal point in the middle."""
    camera = Camera(WIDTH, HEIGHT, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
    uv = [camera.project(p_i), camera.project(se3.transform(T_j_i, p_i))]
    return tuple(x + noise_px * rng.normal(size=x.shape) for x in uv)


def motion(rng):
    """Aside and turning, so that the optical axes neither meet nor are parallel."""
    return se3.exp(np.r_[rng.uniform(0.2, 0.5), rng.uniform(0.1, 0.4), rng.normal(0, 0.1), rng.normal(0, 0.12, 3)])


def pairs(rng, focal, count=20, noise_px=0.0, make_motion=motion, make_points=cloud):
    return [pair(rng, focal, make_motion(rng), make_points(rng), noise_px) for _ in range(count)]


@pytest.mark.parametrize("focal", [300.0, 517.0, 925.0])
def test_focal_length_of_an_exact_fundamental_matrix_is_exact(focal, rng):
    T = motion(rng)
    K_inv = np.linalg.inv(np.diag([focal, focal, 1.0]))
    F = K_inv @ se3.hat(T[:3, 3]) @ T[:3, :3] @ K_inv
    assert focal_of(F, WIDTH) == pytest.approx(focal, rel=1e-3)
    assert focal_of(-7.0 * F, WIDTH) == pytest.approx(focal, rel=1e-3)


def test_no_matrix_no_focal_length():
    assert np.isnan(focal_of(None, WIDTH))
    assert np.isnan(focal_of(np.full((3, 3), np.nan), WIDTH))
    assert np.isnan(focal_of(np.zeros((9, 3)), WIDTH))


@pytest.mark.parametrize("focal", [320.0, 517.0, 800.0])
def test_noise_free_matches_give_the_focal_length_within_a_percent(focal, rng):
    estimate = focal_from_matches(pairs(rng, focal), WIDTH, HEIGHT)
    assert estimate.reason == ""
    assert estimate.focal_px == pytest.approx(focal, rel=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_with_half_a_pixel_of_noise_the_error_is_below_ten_percent_and_three_sigma(seed):
    rng = np.random.default_rng(seed)
    estimate = focal_from_matches(pairs(rng, 517.0, 30, 0.5), WIDTH, HEIGHT)
    assert estimate.focal_px == pytest.approx(517.0, rel=0.10)
    assert abs(estimate.focal_px - 517.0) < 3.0 * estimate.sigma_px
    assert estimate.sigma_px < 0.15 * 517.0


def turning(rng):
    return se3.exp(np.r_[np.zeros(3), rng.normal(0, 0.15, 3)])


def forward(rng):
    return se3.exp(np.array([0.0, 0.0, rng.uniform(-0.9, -0.5), 0.0, 0.0, 0.0]))


def still(rng):
    return se3.exp(rng.normal(0, 0.001, 6))


def plane(rng):
    p = cloud(rng)
    return p * (3.0 / (p @ [0.2, 0.1, 1.0]))[:, None]


@pytest.mark.parametrize(
    ("make_motion", "make_points", "words"),
    [
        (turning, cloud, "a plane or a pure rotation"),
        (motion, plane, "a plane or a pure rotation"),
        (forward, cloud, "pure forward motion"),
        (still, cloud, "hardly any motion"),
        (motion, lambda rng: cloud(rng, 30), "too few matches"),
    ],
)
def test_degenerate_pairs_are_rejected_with_a_reason(make_motion, make_points, words, rng):
    estimate = focal_from_matches(pairs(rng, 517.0, 8, 0.3, make_motion, make_points), WIDTH, HEIGHT)
    assert estimate.focal_px is None
    assert np.isinf(estimate.sigma_px)
    assert words in estimate.reason
    assert "0 of 8" in estimate.reason


def test_good_pairs_suffice_when_most_are_useless(rng):
    mixed = [*pairs(rng, 517.0, 10), *pairs(rng, 517.0, 15, 0.3, turning), *pairs(rng, 517.0, 15, 0.3, still)]
    estimate = focal_from_matches(mixed, WIDTH, HEIGHT)
    assert estimate.focal_px == pytest.approx(517.0, rel=0.03)
    assert 5 <= estimate.pairs_used <= 12
    assert focal_from_matches(mixed[::-1], WIDTH, HEIGHT) == estimate  # whatever the order


def test_random_matches_are_rejected(rng):
    nonsense = [tuple(rng.uniform([0, 0], [WIDTH, HEIGHT], (2, 80, 2))) for _ in range(6)]
    assert focal_from_matches(nonsense, WIDTH, HEIGHT).focal_px is None


def test_no_pairs_give_no_estimate():
    assert focal_from_matches([], WIDTH, HEIGHT) == FocalEstimate(None, np.inf, 0, "0 of 0 image pairs usable")


@pytest.mark.parametrize(
    ("count", "words"), [(0, "image pairs usable"), (1, "image pairs usable"), (12, "too few matches")]
)
def test_too_few_or_black_images_fall_back_with_a_reason(count, words):
    camera = guess_camera([np.zeros((240, 320), np.uint8)] * count, 320, 240)
    assert camera.fx == 384.0
    assert camera.source.startswith("guess: 1.2*max(w,h) = 384 px (") and words in camera.source
    assert camera.focal_sigma == GUESSED_FOCAL_SIGMA


@pytest.mark.slow
def test_a_rendered_flight_gives_it_within_fifteen_percent():
    """ORB's pixel of noise weighs twice at this size; the guess in its place is off by 28 %."""
    lens = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)
    rng = np.random.default_rng(4)
    steps = np.cumsum(rng.normal(0.0, 1.0, (20, 6)) * [0.09, 0.07, 0.03, 0.02, 0.03, 0.03], axis=0)
    steps -= steps.mean(0)
    images = [f.image for f in film(stairs_world(), lens, np.stack([se3.exp(xi) for xi in steps])).frames]
    camera = guess_camera(images, 320, 240)
    assert camera.fx == camera.fy == pytest.approx(300.0, rel=0.15)
    assert (camera.cx, camera.cy) == (159.5, 119.5)
    assert camera.source.startswith("focal from the fundamental matrix")
    assert 0.02 <= camera.focal_sigma <= 0.15


TRUE_LENS = Camera(WIDTH, HEIGHT, 500.0, 510.0, 310.0, 250.0)


def walked_keyframes(rng, count=14, still=False):
    """Keyframes of a camera that walks and turns before a cloud, each keypoint with the anchor of its point."""
    p, T = cloud(rng), np.eye(4)
    keyframes = []
    for k in range(count):
        p_c = se3.transform(T, p)
        uv = TRUE_LENS.project(p_c) + 0.3 * rng.normal(size=(len(p), 2))
        order = rng.permutation(len(p))
        nothing = np.zeros(len(p))
        features = FrameFeatures(uv[order], nothing.astype(int), nothing, rng.integers(0, 256, (len(p), 32), np.uint8))
        keyframes.append(make_keyframe(k, k, 0.1 * k, T, features))
        keyframes[-1].anchor[:] = np.where(order % 10 == 0, -1, order)
        T = T if still else motion(rng) @ T if k % 2 == 0 else se3.inverse(motion(rng)) @ T
    return keyframes


def another_lens(factor, **more):
    return replace(TRUE_LENS, fx=factor * 500.0, fy=factor * 510.0, source="camera.yaml", **more)


@pytest.mark.parametrize("factor", [0.7, 1.3])
def test_a_calibration_of_another_lens_is_contradicted(rng, factor):
    warning = calibration_warning(another_lens(factor), walked_keyframes(rng))
    assert "contradict the calibration" in warning
    assert f"camera.yaml says {500 * factor:.0f} px" in warning
    suggested = float(warning.split("focal length of ")[1].split(" ")[0])
    assert suggested == pytest.approx(500.0, rel=0.06)


def test_a_correct_calibration_gives_no_warning(rng):
    assert calibration_warning(TRUE_LENS, walked_keyframes(rng)) is None


def adapted(camera, keyframes, p_w):
    """Map of a run with a wrong focal length: poses and anchors as a refinement leaves them."""
    problem = _map_problem(camera, keyframes, p_w)
    result = refine_window(problem, LmConfig(max_iterations=50, mu=1e-8))
    for keyframe, T_c_w in zip(keyframes, result.T_c_w, strict=True):
        keyframe.T_c_w = T_c_w
    moved = p_w.copy()
    seen = np.unique(np.concatenate([k.anchor[k.anchor >= 0] for k in keyframes]))
    moved[seen] = result.p_w
    return moved


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.3])
def test_a_refined_map_gives_the_focal_length_and_its_sigma(factor):
    keyframes = walked_keyframes(np.random.default_rng(3), 24)
    camera = another_lens(factor)
    estimate = focal_from_map(camera, keyframes, adapted(camera, keyframes, cloud(np.random.default_rng(3))))
    assert estimate.focal_px == pytest.approx(500.0, rel=0.03)
    assert abs(estimate.focal_px - 500.0) < 2.0 * estimate.sigma_px
    assert contradicts(estimate, camera) is (factor != 1.0)


def test_a_guessed_focal_length_is_not_contradicted(rng):
    assert calibration_warning(another_lens(1.3, focal_sigma=GUESSED_FOCAL_SIGMA), walked_keyframes(rng)) is None


@pytest.mark.parametrize("count", [0, 1, 14])
def test_without_motion_there_is_no_warning(rng, count):
    assert calibration_warning(another_lens(1.3), walked_keyframes(rng, count, still=True)) is None


@pytest.mark.parametrize(
    ("focal", "sigma", "pairs", "is_doubted"),
    [
        (600.0, 20.0, 30, True),
        (600.0, 50.0, 30, False),  # two sigmas
        (565.0, 5.0, 30, True),  # 13 %
        (540.0, 5.0, 30, False),  # sure, but 8 %
        (600.0, 20.0, 9, False),
        (400.0, 20.0, 30, True),
    ],
)
def test_only_a_significant_large_difference_is_a_contradiction(focal, sigma, pairs, is_doubted):
    assert contradicts(FocalEstimate(focal, sigma, pairs, ""), TRUE_LENS) is is_doubted
