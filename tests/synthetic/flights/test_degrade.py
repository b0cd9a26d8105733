"""Camera faults."""

import numpy as np
import pytest

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.synthetic.flights.degrade import (
    CLEAN,
    CameraFaults,
    degraded,
    with_brightness,
    with_motion_blur,
    with_noise,
    with_vignetting,
)

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
DEPTH = np.full((120, 160), 2.0, np.float32)


def step_image():
    image = np.full((120, 160, 3), 40, np.uint8)
    image[:, 80:] = 200
    return image


def test_clean_camera_changes_nothing(rng):
    image = rng.integers(0, 256, (120, 160, 3), dtype=np.uint8)
    twist = np.array([0.5, 0.1, 0.2, 0.3, 0.1, 0.2])
    out = degraded(rng, image, DEPTH, CAMERA, CLEAN, stamp_s=3.0, twist_c=twist)
    np.testing.assert_array_equal(out, image)


def test_noise_has_the_stated_variance_and_no_bias(rng):
    for level in (40, 160):
        image = np.full((240, 320, 3), level, np.uint8)
        noise = with_noise(rng, image, 2.0, 0.3).astype(float) - level
        assert noise.mean() == pytest.approx(0.0, abs=0.05)
        assert noise.var() == pytest.approx(4.0 + 0.09 * level + 1 / 12, rel=0.05)


def test_motion_blur_smears_along_the_motion_by_its_length():
    twist = np.array([1.0, 0, 0, 0, 0, 0])  # 1 m/s to the right at 2 m: 65 px/s to the left
    out = with_motion_blur(step_image(), DEPTH, CAMERA, twist, 0.1)[60, :, 0].astype(float)
    changed = np.flatnonzero((out != 40) & (out != 200))
    assert 5 <= len(changed) <= 8  # 6.5 px
    assert abs(changed.mean() - 79.5) < 0.6  # exposure is centred on the stamp
    across = with_motion_blur(step_image(), DEPTH, CAMERA, np.array([0, 1.0, 0, 0, 0, 0]), 0.1)
    np.testing.assert_array_equal(across[20:100], step_image()[20:100])
    held = with_motion_blur(step_image(), DEPTH, CAMERA, np.array([-1.0, 0, 0, 0, 0.5, 0]), 0.1)
    np.testing.assert_array_equal(held[:, 70:90], step_image()[:, 70:90])  # it turns to what it passes


def test_brightness_follows_the_gain():
    image = np.array([[[0, 100, 255]]], np.uint8)
    np.testing.assert_array_equal(with_brightness(image, 1.2)[0, 0], [0, 120, 255])


def test_vignetting_darkens_the_corners_only():
    image = np.full((121, 161, 3), 200, np.uint8)
    out = with_vignetting(image, 0.3)
    assert out[60, 80, 0] == 200
    assert float(out[0, 0, 0]) == pytest.approx(140, abs=3)


def test_impossible_faults_are_refused():
    with pytest.raises(ValueError, match="must not be negative"):
        CameraFaults(read_noise=-1.0)
    with pytest.raises(ValueError, match="gain positive"):
        CameraFaults(gain=0.0)
