"""Pinhole camera: projection, distortion, resizing."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.geometry.mount import camera_on_body

CAMERA = Camera(640, 480, 500.0, 510.0, 320.0, 240.0)


def test_back_projection_undoes_projection(rng):
    p_c = rng.uniform([-1, -1, 0.5], [1, 1, 6], (50, 3))
    np.testing.assert_allclose(CAMERA.back_project(CAMERA.project(p_c), p_c[:, 2]), p_c, atol=1e-12)


@pytest.mark.parametrize("name", ["tum_fr1", "tum_fr2"])
def test_undistorted_points_are_where_the_pinhole_sees_them(name, rng):
    camera = PRESETS[name]
    p_c = rng.uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.0], (40, 3))
    distorted = cv2.projectPoints(p_c, np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion))[0][:, 0]
    # OpenCV inverts the distortion with five fixed-point steps.
    np.testing.assert_allclose(camera.undistort_points(distorted), camera.project(p_c), atol=0.05)


def test_distorting_undoes_undistorting(rng):
    camera = PRESETS["tum_fr1"]
    raw = rng.uniform((0, 0), (640, 480), (200, 2))
    np.testing.assert_allclose(camera.distort_points(camera.undistort_points(raw)), raw, atol=0.05)


def test_resized_camera_sees_the_corners_of_the_image_at_its_corners():
    """Pixel centres at integers: the image spans -0.5 to width - 0.5 at any size."""
    half = CAMERA.scaled(320, 240)
    corner = CAMERA.back_project(np.array([[-0.5, -0.5], [639.5, 479.5]]), np.ones(2))
    np.testing.assert_allclose(half.project(corner), [[-0.5, -0.5], [319.5, 239.5]], atol=1e-12)
    back = half.scaled(640, 480)
    np.testing.assert_allclose(back.K, CAMERA.K)


@pytest.mark.parametrize(
    "numbers", [(0, 480, 500, 500, 320, 240), (640, 480, -1, 500, 320, 240), (640, 480, np.nan, 500, 320, 240)]
)
def test_implausible_cameras_are_rejected(numbers):
    with pytest.raises(CalibrationError):
        Camera(*numbers)


def test_mounted_camera_looks_down_by_its_tilt():
    T_b_c = camera_on_body(np.deg2rad(12.0), 0.03)
    np.testing.assert_allclose(T_b_c[:3, 2], [np.cos(np.deg2rad(12)), 0.0, -np.sin(np.deg2rad(12))])
    np.testing.assert_allclose(T_b_c[:3, 0], [0.0, -1.0, 0.0])  # camera right is body right
    np.testing.assert_allclose(T_b_c[:3, :3] @ T_b_c[:3, :3].T, np.eye(3), atol=1e-15)
    assert np.linalg.det(T_b_c[:3, :3]) > 0
    np.testing.assert_allclose(T_b_c[:3, 3], [0.03, 0.0, 0.0])


def test_undistorted_image_shows_a_point_where_undistorted_points_say():
    camera = PRESETS["tum_fr1"]
    image = np.zeros((480, 640), np.uint8)
    at = np.array([[100.0, 90.0]])
    cv2.circle(image, (100, 90), 6, 255, -1, cv2.LINE_AA)
    v, u = np.nonzero(camera.undistort_image(image) > 127)
    np.testing.assert_allclose([u.mean(), v.mean()], camera.undistort_points(at)[0], atol=0.35)
