"""CameraInfo of all models, against OpenCV's own projections."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.readers.bags.camera_info import camera_from_info

K = np.array([[500.0, 0, 320.0], [0, 505.0, 240.0], [0, 0, 1]])


def _info(model="plumb_bob", d=(), **changes):
    roi = SimpleNamespace(x_offset=0, y_offset=0, width=0, height=0)
    p = np.hstack([np.diag([450.0, 450.0, 1.0]), np.zeros((3, 1))])
    p[:2, 2] = 310.0, 235.0
    fields = {"k": K.ravel(), "d": np.array(d), "p": p.ravel(), "width": 640, "height": 480, "roi": roi}
    fields |= {"distortion_model": model, "binning_x": 0, "binning_y": 0} | changes
    return SimpleNamespace(**fields)


def _points():
    x, y = np.meshgrid(np.linspace(-0.55, 0.55, 9), np.linspace(-0.42, 0.42, 9))
    return np.stack([x.ravel(), y.ravel(), np.ones(81)], axis=1)


def test_plumb_bob_of_four_and_five_numbers_and_ros_1_names():
    four = camera_from_info(_info(d=(0.1, -0.2, 0.003, 0.004)), "x", False)[0]
    assert four.distortion == (0.1, -0.2, 0.003, 0.004, 0.0)
    info = _info(d=(0.1, -0.2, 0.003, 0.004, 0.05))
    old = SimpleNamespace(**{k.upper() if k in "kdp" else k: v for k, v in vars(info).items()})
    assert camera_from_info(old, "x", False)[0].distortion == (0.1, -0.2, 0.003, 0.004, 0.05)
    assert (four.fx, four.fy, four.cx, four.cy) == (500.0, 505.0, 320.0, 240.0)


def test_a_rational_lens_is_fitted_within_a_third_of_a_pixel():
    d = np.array([0.5, -0.2, 0.0005, -0.0003, 0.02, 0.6, -0.22, 0.01])
    camera = camera_from_info(_info("rational_polynomial", d), "x", False)[0]
    truth, _ = cv2.projectPoints(_points(), np.zeros(3), np.zeros(3), K, d)
    truth = truth.reshape(-1, 2)
    seen = ((truth >= 0) & (truth < [640, 480])).all(axis=1)
    assert seen.sum() > 40
    assert np.abs(camera.project_through_lens(_points()) - truth)[seen].max() < 0.35


def test_a_narrow_fisheye_is_fitted_and_a_wide_one_refused():
    d = np.array([0.02, -0.01, 0.003, 0.0])
    camera = camera_from_info(_info("equidistant", d), "x", False)[0]
    truth, _ = cv2.fisheye.projectPoints(_points()[:, None], np.zeros(3), np.zeros(3), K, d)
    truth = truth.reshape(-1, 2)
    seen = ((truth >= 0) & (truth < [640, 480])).all(axis=1)
    assert np.abs(camera.project_through_lens(_points()) - truth)[seen].max() < 0.35
    wide = np.array([[200.0, 0, 320], [0, 200.0, 240], [0, 0, 1]])
    with pytest.raises(CalibrationError, match="equidistant.*--camera FILE"):
        camera_from_info(_info("fisheye", d, k=wide.ravel()), "x", False)


def test_rectified_pictures_take_the_projection_and_no_distortion():
    camera = camera_from_info(_info(d=(0.1, -0.2, 0.003, 0.004)), "x", True)[0]
    assert (camera.fx, camera.cx, camera.cy, camera.is_distorted) == (450.0, 310.0, 235.0, False)


def test_empty_parts_and_unknown_models():
    assert camera_from_info(_info(k=np.zeros(9)), "x", False)[0] is None
    part = SimpleNamespace(x_offset=10, y_offset=0, width=320, height=240)
    with pytest.raises(CalibrationError, match="part of the image"):
        camera_from_info(_info(roi=part), "x", False)
    with pytest.raises(CalibrationError, match="part of the image"):
        camera_from_info(_info(binning_x=2), "x", False)
    with pytest.raises(CalibrationError, match="'omni'"):
        camera_from_info(_info("omni", (1, 2, 3, 4, 5)), "x", False)
    whole = SimpleNamespace(x_offset=0, y_offset=0, width=640, height=480)
    assert camera_from_info(_info(roi=whole, binning_x=1, binning_y=1), "x", False)[0] is not None
