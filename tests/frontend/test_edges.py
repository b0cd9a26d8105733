"""Edge pixels with normals and colours."""

import cv2
import numpy as np
import pytest
from rendered import views

from edgeslam_torch.frontend.canny import edge_thresholds, noise
from edgeslam_torch.frontend.edges import extract_edges


def test_normal_of_a_slanted_step_points_to_the_bright_side():
    v, u = np.mgrid[0:120, 0:160]
    direction = np.array([np.cos(0.4), np.sin(0.4)])
    ramp = (u - 80) * direction[0] + (v - 60) * direction[1]
    image = np.clip(120 + 60 * ramp, 50, 190).astype(np.uint8)
    edges = extract_edges(image, 40.0, 100.0, 5000)
    assert len(edges.uv) > 50
    assert (edges.normal @ direction).min() > np.cos(np.deg2rad(10))
    distance = (edges.uv - [80, 60]) @ direction
    assert np.abs(distance).max() < 1.5


@pytest.mark.parametrize("most", [1000, 3000])
def test_thinning_respects_the_limit_and_preserves_coverage(most):
    image = views()[0]
    every = extract_edges(image, 40.0, 100.0, 100_000).uv
    some = extract_edges(image, 40.0, 100.0, most).uv
    assert len(some) == most < len(every)
    assert {tuple(p) for p in some} <= {tuple(p) for p in every}
    cells = [{tuple(c) for c in (uv // 40).astype(int)} for uv in (every, some)]
    # Each 40 px cell that had a fair share of edges keeps some.
    crowded = {c for c in cells[0] if ((every // 40).astype(int) == c).all(1).sum() > 3 * len(every) / most}
    assert crowded <= cells[1]


def in_the_dark(image, exposure, noise_grey):
    """The picture that a camera takes with so much less light: darker, as noisy as before, in whole grey levels."""
    noisy = exposure * image + noise_grey * np.random.default_rng(3).standard_normal(image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("exposure", "found", "right"), [(0.5, 0.9, 0.95), (0.25, 0.9, 0.9), (0.15, 0.9, 0.8)])
def test_edges_of_a_dark_room_are_those_of_the_lit_one(exposure, found, right):
    grey = cv2.cvtColor(views()[0], cv2.COLOR_BGR2GRAY)
    grey = in_the_dark(grey, 130.0 / np.percentile(grey, 95), 1.5)  # just well exposed
    lit = extract_edges(grey, 40.0, 100.0, 10**6).uv.astype(int)
    dark = extract_edges(in_the_dark(grey, exposure, 1.5), 40.0, 100.0, 10**6).uv.astype(int)
    for these, those, share in ((lit, dark, found), (dark, lit, right)):
        assert near(those, grey.shape)[these[:, 1], these[:, 0]].mean() >= share


def near(uv, shape):
    """Pixels within two of some edge."""
    mask = np.zeros(shape, np.uint8)
    mask[uv[:, 1], uv[:, 0]] = 1
    return cv2.dilate(mask, np.ones((5, 5), np.uint8)).astype(bool)


@pytest.mark.parametrize("noise_grey", [0.5, 1.5, 4.0])
def test_noise_in_the_dark_is_no_edge(noise_grey):
    wall = in_the_dark(np.full((480, 640), 20.0), 1.0, noise_grey)
    assert len(extract_edges(wall, 40.0, 100.0, 10**6).uv) < 1e-4 * wall.size


def test_thresholds_of_well_exposed_pictures_are_as_given():
    grey = cv2.cvtColor(views()[0], cv2.COLOR_BGR2GRAY)
    assert np.percentile(grey, 95) > 128
    assert edge_thresholds(grey, 40.0, 100.0) == (40.0, 100.0)
    low, high = edge_thresholds(in_the_dark(grey, 0.25, 0.0), 40.0, 100.0)
    assert high == pytest.approx(100.0 * 0.25 * np.percentile(grey, 95) / 128.0, rel=0.1)
    assert low == pytest.approx(0.4 * high)


def test_normals_are_unit_and_nothing_lies_at_the_border():
    edges = extract_edges(views()[0], 40.0, 100.0, 100_000, border_px=6)
    np.testing.assert_allclose(np.linalg.norm(edges.normal, axis=1), 1.0, atol=1e-5)
    assert edges.uv.min() >= 6
    assert (edges.uv < [320 - 6, 240 - 6]).all()


@pytest.mark.parametrize("sigma", [1.0, 3.0])
def test_noise_is_that_of_a_shaded_wall(sigma):
    shaded = np.tile(np.linspace(60.0, 120.0, 640), (480, 1))
    assert noise(in_the_dark(shaded, 1.0, sigma)) == pytest.approx(np.hypot(sigma, 1 / np.sqrt(12)), rel=0.05)
