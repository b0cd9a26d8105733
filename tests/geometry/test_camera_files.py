"""Calibration files: the three supported kinds, and the errors for others."""

from dataclasses import replace

import pytest

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.camera_file import load_camera, save_camera

GOOD = "width: 640\nheight: 480\nfx: 500\nfy: 501\ncx: 320\ncy: 240\n"
ROS = (
    "image_width: 640\nimage_height: 480\ncamera_matrix: {data: [500, 0, 320, 0, 501, 240, 0, 0, 1]}\n"
    "distortion_model: plumb_bob\ndistortion_coefficients: {data: [0.1, -0.2, 0.003, 0.004, 0.05]}\n"
)
LAUGHS = "a: &a [x, x, x]\n" + "".join(f"{n}: &{n} [*{m}, *{m}, *{m}]\n" for m, n in ("ab", "bc", "cd"))


def test_own_file_round_trips(tmp_path):
    save_camera(tmp_path / "camera.yaml", PRESETS["tum_fr1"])
    back = load_camera(tmp_path / "camera.yaml")
    assert (back.fx, back.cy, back.distortion) == (517.306408, 255.313989, PRESETS["tum_fr1"].distortion)


def test_the_focal_sigma_is_saved_with_the_file(tmp_path):
    save_camera(tmp_path / "camera.yaml", replace(PRESETS["kinect"], focal_sigma=0.12))
    assert load_camera(tmp_path / "camera.yaml").focal_sigma == 0.12
    (tmp_path / "plain.yaml").write_text(GOOD)
    assert load_camera(tmp_path / "plain.yaml").focal_sigma == 0.0


def test_ros_file(tmp_path):
    (tmp_path / "ost.yaml").write_text(ROS)
    camera = load_camera(tmp_path / "ost.yaml")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500.0, 501.0, 320.0, 240.0)
    assert camera.distortion == (0.1, -0.2, 0.003, 0.004, 0.05)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_load_with_their_source(name):
    assert load_camera(name).source == f"preset {name}"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no key: value lines"),
        ("just words", "no key: value lines"),
        ("[" * 3000, "not a camera calibration"),
        (GOOD.replace("fx: 500", "fx: -500"), "must be positive"),
        (GOOD.replace("fx: 500", "fx: .nan"), "not finite"),
        (GOOD.replace("fx: 500", "fx: 3.6"), "cannot be pixels"),
        (GOOD + "distortion: [1.0e+300, 0, 0, 0, 0]\n", "cannot be a lens's"),
        (GOOD + "distortion: [.inf, 0, 0, 0, 0]\n", "not finite"),
        (GOOD + LAUGHS + "distortion_model: *d\n", "aliases are not read"),
        (GOOD + "fx: " + "9" * 5000 + "\n", "not a camera calibration"),
        (GOOD.replace("width: 640", "width: .inf"), "not finite"),
        (GOOD.replace("fy: 501\n", ""), "does not state fy"),
        (GOOD + "focal_sigma: -0.1\n", "focal_sigma must be at least 0"),
        (GOOD + "focal_sigma: .nan\n", "not finite"),
        (GOOD + "model: fisheye\n", "no distortion coefficients"),
        (GOOD + "distortion: [1, 2, 3, 4, 5, 6]\n", "6 distortion coefficients"),
        (ROS.replace("plumb_bob", "equidistant"), "equidistant takes 4"),
    ],
)
def test_an_invalid_file_is_rejected_by_name(tmp_path, text, words):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(CalibrationError, match=f"c.yaml: .*{words}"):
        load_camera(tmp_path / "c.yaml")


@pytest.mark.parametrize("line", ["", "distortion_model:\n", "distortion_model: none\n"])
def test_a_lens_without_description_has_no_distortion(tmp_path, line):
    (tmp_path / "c.yaml").write_text(GOOD + line)
    assert not load_camera(tmp_path / "c.yaml").is_distorted
