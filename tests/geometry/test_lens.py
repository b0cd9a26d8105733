"""Plausibility of calibrations."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.geometry.lens import _distorted, check_camera, unique_share

REAL = {
    # TUM RGB-D, KITTI raw 2011_09_26 camera 0, EuRoC cam0, a Tello by ROS camera_calibration: as published.
    "fr1": PRESETS["tum_fr1"],
    "fr2": PRESETS["tum_fr2"],
    "kitti": Camera(
        1392, 512, 984.2439, 980.8141, 690.0, 233.1966, (-0.3728755, 0.2037299, 0.002219, 0.001384, -0.07233722)
    ),
    "euroc": Camera(752, 480, 458.654, 457.296, 367.215, 248.375, (-0.28340811, 0.07395907, 0.00019359, 1.76e-05, 0.0)),
    "tello": Camera(960, 720, 924.87, 923.5, 487.0, 364.3, (-0.034749, 0.071514, 0.000363, 0.003131, 0.0)),
}


@pytest.mark.parametrize("name", REAL)
def test_real_lenses_are_one_to_one_over_the_whole_image(name):
    assert unique_share(REAL[name]) == 1.0
    check_camera(REAL[name])


@pytest.mark.parametrize("k1", [-0.1, -0.25, -0.35, -0.6])
def test_the_invertible_share_of_a_barrel_ends_at_its_fold(k1):
    """r (1 + k1 r^2) is largest at r = 1 / sqrt(-3 k1): two thirds of that."""
    camera = Camera(640, 480, 400.0, 400.0, 319.5, 239.5, (k1, 0.0, 0.0, 0.0, 0.0))
    turn = 2.0 / 3.0 / np.sqrt(-3.0 * k1)
    corner = np.hypot(320.0, 240.0) / 400.0
    assert unique_share(camera) == pytest.approx(min(1.0, turn / corner), abs=0.01)


def test_points_and_area_are_those_of_opencvs_projection(rng):
    distortion = np.array([-0.2, 0.05, 0.01, -0.02, 0.003])
    xy, h = rng.uniform(-0.8, 0.8, (2, 30)), 1e-5

    def seen(xy):
        p_c = np.concatenate([xy, np.ones((1, 30))]).T
        return cv2.projectPoints(p_c, np.zeros(3), np.zeros(3), np.eye(3), distortion)[0][:, 0].T

    points, area = _distorted(Camera(640, 480, 400.0, 400.0, 319.5, 239.5, tuple(distortion)), xy)
    np.testing.assert_allclose(points, seen(xy), atol=1e-12)
    by_x, by_y = ((seen(xy + step) - seen(xy - step)) / (2 * h) for step in h * np.eye(2)[:, :, None])
    np.testing.assert_allclose(area, by_x[0] * by_y[1] - by_x[1] * by_y[0], rtol=1e-6)


USUAL = (500.0, 500.0, 320.0, 240.0)


@pytest.mark.parametrize(
    ("numbers", "distortion"),
    [
        (USUAL, (1e300, 0.0, 0.0, 0.0, 0.0)),
        (USUAL, (1e300, -1e300, 0.0, 0.0, 0.0)),
        (USUAL, (0.0, 0.0, 0.5, 0.0, 0.0)),
        (USUAL, (0.0, 0.0, 0.0, 0.0, -5.0)),
        ((63.0, 500.0, 320.0, 240.0), ()),
        ((500.0, 12801.0, 320.0, 240.0), ()),
        ((500.0, 1501.0, 320.0, 240.0), ()),
        ((500.0, 500.0, -321.0, 240.0), ()),
        ((500.0, 500.0, 320.0, 721.0), ()),
    ],
)
def test_implausible_lenses_are_rejected_and_a_cropped_image_is_not(numbers, distortion):
    check_camera(Camera(640, 480, 500.0, 500.0, 800.0, 240.0, (-0.1, 0.02, 0.0, 0.0, 0.0)))
    with pytest.raises(CalibrationError):
        check_camera(Camera(640, 480, *numbers, *([distortion] if distortion else [])))
