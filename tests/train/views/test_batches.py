"""Views in batches are turned and zoomed as single ones are."""

import cv2
import numpy as np
import torch

from edgeslam_torch.train.views import batches
from edgeslam_torch.train.views.augment import AugmentConfig, View, scaled_K, warp
from edgeslam_torch.types import FloatArray

SIZE = (96, 128)
CPU = torch.device("cpu")
PLAIN = AugmentConfig(
    flip=0,
    zoom=(1, 1),
    aspect=0,
    roll_rad=0,
    tilt_rad=0,
    shift=0,
    brightness=0,
    contrast=0,
    saturation=0,
    channel=0,
    gamma=(1, 1),
    grey=0,
    blur=0,
    noise=0,
)


def planes() -> list[View]:
    """Two tilted planes with smooth colours, of different cameras."""
    views = []
    for focal, normal in ((110.0, (0.2, -0.1, -1.0)), (150.0, (-0.3, 0.2, -1.0))):
        K = np.array([[focal, 0, 79.5], [0, focal, 59.5], [0, 0, 1]])
        u, v = np.meshgrid(np.arange(160), np.arange(120))
        rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
        depth = (-2.0 / (rays @ np.array(normal))).astype(np.float32)
        p = rays * depth[..., None]
        image = 127 + 100 * np.stack([np.sin(2 * p[..., 0]), np.cos(p[..., 1]), np.sin(p[..., 0] - p[..., 1])], -1)
        views.append(View(image.astype(np.uint8), depth, K))
    return views


def cameras(views: list[View]) -> tuple[FloatArray, FloatArray]:
    """A zoomed, shifted and turned camera for each view."""
    K, R = [], []
    for view, (turn, zoom) in zip(views, (((0.1, -0.08, 0.15), 1.3), ((-0.05, 0.12, -0.4), 0.9)), strict=True):
        k = scaled_K(view.K, zoom, 0.9 * zoom)
        k[0, 2] -= 15
        K.append(k)
        R.append(cv2.Rodrigues(np.array(turn))[0])
    return np.stack(K), np.stack(R)


def test_a_batch_is_warped_as_single_views_are() -> None:
    views = planes()
    K, R = cameras(views)
    image, depth = batches.warped(batches.on_device(views, (120, 160), CPU), K, R, SIZE)
    for k, view in enumerate(views):
        single = warp(view, K[k], R[k], SIZE)
        both = (single.depth_m > 0) & (depth[k, 0].numpy() > 0)
        assert both.mean() > 0.6
        assert ((single.depth_m > 0) == (depth[k, 0].numpy() > 0)).mean() > 0.98  # borders round differently
        apart = np.abs(np.log(depth[k, 0].numpy()[both] / single.depth_m[both]))
        assert np.quantile(apart, 0.95) < 2e-3  # float16, and now and then the neighbouring pixel
        assert np.abs(image[k].permute(1, 2, 0).numpy()[..., ::-1] * 255 - single.image)[both].mean() < 1.0


def test_a_camera_that_changes_nothing_gives_the_view() -> None:
    views = planes()
    image, depth, focal_px = batches.random_views(
        batches.on_device(views, (120, 160), CPU), (120, 160), PLAIN, np.random.default_rng(0)
    )
    np.testing.assert_allclose(focal_px, [110, 150])
    for k, view in enumerate(views):
        np.testing.assert_allclose(image[k].permute(1, 2, 0).numpy()[..., ::-1] * 255, view.image, atol=0.02)
        np.testing.assert_allclose(depth[k, 0].numpy(), view.depth_m, rtol=1e-3)


def test_mirrored_depth_goes_with_its_image() -> None:
    view = planes()[0]
    flipped = AugmentConfig(**{**{name: getattr(PLAIN, name) for name in PLAIN.__slots__}, "flip": 1.0})
    image, depth, _ = batches.random_views(
        batches.on_device([view], (120, 160), CPU), (120, 160), flipped, np.random.default_rng(0)
    )
    np.testing.assert_allclose(depth[0, 0].numpy(), view.depth_m[:, ::-1], rtol=1e-3)
    np.testing.assert_allclose(image[0].permute(1, 2, 0).numpy()[..., ::-1] * 255, view.image[:, ::-1], atol=0.02)


def test_the_same_seed_asks_for_the_same_views() -> None:
    stored = batches.on_device(planes(), (120, 160), CPU)
    config = AugmentConfig(blur=1.0, noise=1.0)
    first, depth, _ = batches.random_views(stored, SIZE, config, np.random.default_rng(3))
    again, _, _ = batches.random_views(stored, SIZE, config, np.random.default_rng(3))
    other, _, _ = batches.random_views(stored, SIZE, config, np.random.default_rng(4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    assert first.min() >= 0 and first.max() <= 1 and depth.isfinite().all()


def test_blur_kernels_keep_the_brightness_and_spread_it() -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        kernel = batches._kernel(rng)
        assert kernel.sum() == np.float64(1.0) or abs(kernel.sum() - 1) < 1e-12
        assert kernel.min() >= 0 and kernel.max() < 0.95
    point = torch.zeros(2, 3, 21, 21)
    point[:, :, 10, 10] = 1.0
    kernels = torch.stack([torch.from_numpy(batches._kernel(rng)).float() for _ in range(2)])
    blurred = batches._blurred(point, kernels)
    torch.testing.assert_close(blurred[:, 1, 6:15, 6:15], kernels.flip(-1, -2))
