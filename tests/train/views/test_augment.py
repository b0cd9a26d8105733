"""Augmentation keeps image, depth and intrinsics together."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.train.views.augment import AugmentConfig, View, fitted_view, mirrored, random_view, scaled_K, warp

PLAIN = AugmentConfig(brightness=0, contrast=0, saturation=0, channel=0, gamma=(1, 1), grey=0, blur=0, noise=0)


def plane_view(normal=(0.2, -0.1, -1.0), distance=2.0):
    """A tilted plane n . p = -distance whose colour is a smooth function of the 3-D point."""
    K = np.array([[110.0, 0, 79.5], [0, 110.0, 59.5], [0, 0, 1]])
    u, v = np.meshgrid(np.arange(160), np.arange(120))
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
    depth = (-distance / (rays @ np.array(normal))).astype(np.float32)
    return View(colour_of(rays * depth[..., None]), depth, K)


def colour_of(p):
    channels = [np.sin(2 * p[..., 0]), np.cos(1.5 * p[..., 1] + p[..., 0]), np.sin(p[..., 0] - p[..., 1])]
    return np.asarray(127 + 100 * np.stack(channels, -1), np.uint8)


def points(view):
    h, w = view.depth_m.shape
    u, v = np.meshgrid(np.arange(w), np.arange(h))
    rays = np.stack([(u - view.K[0, 2]) / view.K[0, 0], (v - view.K[1, 2]) / view.K[1, 1], np.ones(u.shape)], -1)
    return rays * view.depth_m[..., None]


def test_rotated_zoomed_view_is_the_same_plane_in_the_new_camera():
    view = plane_view()
    R, _ = cv2.Rodrigues(np.array([0.1, -0.08, 0.15]))
    K = scaled_K(view.K, 1.3, 1.2)
    K[0, 2] -= 25
    new = warp(view, K, R, (96, 128))
    known = new.depth_m > 0
    assert known.mean() > 0.7
    p_old = points(new)[known] @ R  # R^T p_new
    # Nearest-neighbour depth moves a sample by up to half a pixel: 0.5 / 110 * 2 m * slope.
    on_plane = p_old @ np.array([0.2, -0.1, -1.0]) + 2.0
    assert np.abs(on_plane).max() < 0.02
    difference = np.abs(new.image[known].astype(int) - colour_of(p_old).astype(int))
    assert np.median(difference) <= 3


def test_squeezed_image_has_squeezed_intrinsics():
    small = fitted_view(plane_view(), (60, 80))
    np.testing.assert_allclose(small.K, scaled_K(plane_view().K, 0.5, 0.5))
    assert small.K[0, 2] == pytest.approx(39.5)  # the centre stays the centre
    on_plane = points(small) @ np.array([0.2, -0.1, -1.0]) + 2.0
    assert np.abs(on_plane).max() < 0.02


def test_random_views_keep_the_plane_flat_and_follow_the_seed():
    view = plane_view()
    for seed in range(5):
        new = random_view(view, (64, 96), PLAIN, np.random.default_rng(seed))
        assert new.image.shape == (64, 96, 3)
        p = points(new)[new.depth_m > 0]
        centred = p - p.mean(0)
        assert np.sqrt(np.linalg.svd(centred, compute_uv=False)[-1] ** 2 / len(p)) < 0.02
    a, b = (random_view(view, (64, 96), AugmentConfig(), np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(a.image, b.image)
    np.testing.assert_array_equal(a.depth_m, b.depth_m)


def test_mirror_twice_is_the_same():
    view = plane_view()
    once = mirrored(view)
    assert once.K[0, 2] == pytest.approx(159 - view.K[0, 2])
    flipped = points(once)[:, ::-1] * (-1, 1, 1)
    np.testing.assert_allclose(flipped, points(view), atol=1e-5)
    np.testing.assert_array_equal(mirrored(once).image, view.image)


def test_holes_stay_holes():
    view = plane_view()
    view.depth_m[:, :80] = 0
    new = warp(view, view.K, np.eye(3), (120, 160))
    np.testing.assert_array_equal(new.depth_m == 0, view.depth_m == 0)


def test_a_smaller_view_mixes_no_depths(rng):
    depth = rng.choice([0.0, 1.0, 5.0], (40, 60)).astype(np.float32)
    small = fitted_view(View(np.zeros((40, 60, 3), np.uint8), depth, np.eye(3)), (16, 24))
    assert set(np.unique(small.depth_m)) <= {0.0, 1.0, 5.0}
