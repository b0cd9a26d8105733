"""Calibrations that are possible and unlikely: of other sizes, of stretched pictures; a Tello at low resolution."""

import pytest

from edgeslam_torch.calibration.camera_choice import CALIBRATION_FILES, choose_camera
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


@pytest.mark.parametrize(("cx", "cy"), [(500.0, 239.5), (319.5, 80.0), (639.0, 239.5)])
def test_one_far_from_the_middle_is_warned_of(cx, cy):
    assert any("principal point" in doubt for doubt in _doubts(cx=cx, cy=cy))


@pytest.mark.parametrize(("fx", "is_doubted"), [(500.0, False), (533.0, False), (1000.0, True), (250.0, True)])
def test_focal_lengths_of_oblong_pixels_are_warned_of(fx, is_doubted):
    assert any("times fy" in doubt for doubt in _doubts(fx=fx)) is is_doubted


@pytest.mark.parametrize("line", ["500 500 639.5 479.5", "500 500 639.5 479.5\n640 480"])
def test_a_line_of_numbers_for_other_images_is_refused_and_read_with_their_size(tmp_path, line):
    (tmp_path / "calib.txt").write_text(line)
    with pytest.raises(CalibrationError, match="1280x960"):
        choose_camera(SIZE, tmp_path / "calib.txt")
    (tmp_path / "calib.txt").write_text(line.split("\n")[0] + "\n1280 960\n")
    camera, notes = choose_camera(SIZE, tmp_path / "calib.txt")
    assert (camera.fx, camera.cx) == (250.0, 319.5)
    assert any("scaled" in note for note in notes)


@pytest.mark.parametrize("name", CALIBRATION_FILES)
def test_a_calibration_beside_the_images_is_found(tmp_path, name):
    (tmp_path / name).write_text("500 501 320 240 0.1 0 0 0\n640 480\n")
    camera, _ = choose_camera(SIZE, folders=[tmp_path])
    assert (camera.fx, camera.distortion[0]) == (500.0, 0.1)


def test_a_tello_at_low_resolution_has_its_own_lens():
    camera, notes = choose_camera((648, 478), is_drone=True)
    assert "Tello" in camera.source
    assert camera.fx == camera.fy == pytest.approx(925.0 * 648 / 960)
    assert camera.cy == pytest.approx(239.0, abs=2.0)
    assert any("Tello" in note for note in notes)
    assert choose_camera((960, 720), is_drone=True)[0].K.tolist() == [[925, 0, 485], [0, 925, 360], [0, 0, 1]]


@pytest.mark.parametrize(("cx", "cy"), [(318.6, 255.3), (355.0, 270.0), (290.0, 210.0)])
def test_usual_principal_points_pass_without_a_word(cx, cy):
    assert _doubts(cx=cx, cy=cy) == []
