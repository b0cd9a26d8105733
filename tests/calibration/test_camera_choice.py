"""Calibrations that are possible and unlikely: of other sizes, of stretched pictures; a Tello at low resolution."""

import pytest

from edgeslam_torch.calibration.camera_choice import choose_camera
from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import Camera

SIZE = (640, 480)


def _doubts(fx=500.0, fy=500.0, cx=319.5, cy=239.5):
    return choose_camera(SIZE, own=Camera(*SIZE, fx, fy, cx, cy))[1]


@pytest.mark.parametrize(
    ("scale", "size"), [(2.0, "1280x960"), (0.5, "320x240"), (1.5, "960x720"), (2.0 / 3.0, "427x320")]
)
@pytest.mark.parametrize("off", [0.96, 1.05])
def test_a_principal_point_of_larger_or_smaller_images_is_refused_with_their_size(scale, size, off):
    with pytest.raises(CalibrationError, match=size):
        _doubts(cx=off * scale * 320 - 0.5, cy=scale * 240 - 0.5)


@pytest.mark.parametrize(
    ("camera", "words"),
    [({"cx": 500.0}, ["principal point"]), ({"cy": 80.0}, ["principal point"]), ({"cx": 639.0}, ["principal point"]),
     ({"fx": 1000.0}, ["times fy"]), ({"fx": 250.0}, ["times fy"]), ({"fx": 533.0}, []),
     ({"cx": 318.6, "cy": 255.3}, []), ({"cx": 355.0, "cy": 270.0}, []), ({"cx": 290.0, "cy": 210.0}, [])],
)  # fmt: skip
def test_one_far_from_the_middle_and_oblong_pixels_are_warned_of(camera, words):
    said = _doubts(**camera)
    assert len(said) == len(words) and all(word in doubt for word, doubt in zip(words, said, strict=True))


@pytest.mark.parametrize("line", ["500 500 639.5 479.5", "500 500 639.5 479.5\n640 480"])
def test_a_line_of_numbers_for_other_images_is_refused_and_read_with_their_size(tmp_path, line):
    (tmp_path / "calib.txt").write_text(line)
    with pytest.raises(CalibrationError, match="1280x960"):
        choose_camera(SIZE, tmp_path / "calib.txt")
    (tmp_path / "calib.txt").write_text(line.split("\n")[0] + "\n1280 960\n")
    camera, notes = choose_camera(SIZE, tmp_path / "calib.txt")
    assert (camera.fx, camera.cx) == (250.0, 319.5)
    assert any("scaled" in note for note in notes)


def test_a_tello_at_low_resolution_has_its_own_lens():
    camera, notes = choose_camera((648, 478), is_drone=True)
    assert "Tello" in camera.source
    assert camera.fx == camera.fy == pytest.approx(925.0 * 648 / 960)
    assert camera.cy == pytest.approx(239.0, abs=2.0)
    assert any("Tello" in note for note in notes)
    assert choose_camera((960, 720), is_drone=True)[0].K.tolist() == [[925, 0, 485], [0, 925, 360], [0, 0, 1]]
