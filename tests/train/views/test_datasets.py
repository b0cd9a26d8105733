"""Folders with depth: paired, undistorted, holes kept, unreadable files named."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from depth_folder import CAMERA, write_folder

from edgeslam_torch.errors import EdgeSlamError, SourceError
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.train.views.datasets import has_depth, load_depth_folder


def test_depth_is_metres_and_holes_are_zero(tmp_path):
    folder = load_depth_folder(write_folder(tmp_path / "a"))
    assert len(folder.views) == 12
    depth = folder.views[0].depth_m
    assert (depth[:12] == 0).all()
    np.testing.assert_allclose(depth[20], np.linspace(1, 3, 64), atol=1e-3)
    assert len(load_depth_folder(tmp_path / "a", stride=3, max_frames=9).views) == 3


def test_distorted_lens_is_straightened_without_mixing_depths(tmp_path):
    bent = replace(CAMERA, distortion=(0.3, 0.0, 0.0, 0.0, 0.0))
    depth = load_depth_folder(write_folder(tmp_path / "a", 1, bent)).views[0].depth_m
    levels = np.round(np.linspace(1000, 3000, 64)) / 1000
    assert np.abs(depth[depth > 0][:, None] - levels).min(1).max() < 2e-3


def test_unreadable_files_are_listed_and_the_rest_is_used(tmp_path):
    folder = write_folder(tmp_path / "a")
    (folder / "rgb" / "3.png").write_bytes(b"broken")
    (folder / "depth" / "5.png").unlink()
    loaded = load_depth_folder(folder)
    assert len(loaded.views) == 10
    said = [f"{Path(p).parent.name}/{Path(p).name}".lower() for p in loaded.left_out]
    assert said[0] == "rgb/3.png: unreadable" and said[1].startswith("depth/5.png: no such file")


def test_recording_with_depth_is_told_from_one_without(tmp_path):
    folder = write_folder(tmp_path / "a", 1)
    assert has_depth(folder)
    assert not has_depth(tmp_path) and not has_depth(tmp_path / "none")
    (folder / "camera.yaml").unlink()
    assert not has_depth(folder)
    with pytest.raises(EdgeSlamError, match="the camera is not known"):
        load_depth_folder(folder)
    (folder / "depth.txt").unlink()
    with pytest.raises(EdgeSlamError, match="no depth.txt"):
        load_depth_folder(folder)


def test_line_that_is_none_is_left_out_by_name(tmp_path):
    folder = write_folder(tmp_path / "a", 2)
    with (folder / "depth.txt").open("a") as file:
        file.write("not a list\n")
    loaded = load_depth_folder(folder)
    assert len(loaded.views) == 2 and "depth.txt:3: not 'stamp path'" in loaded.left_out[0]
    (folder / "depth.txt").write_text("not a list\n")
    with pytest.raises(EdgeSlamError, match=r"depth\.txt:1"):
        load_depth_folder(folder)


def test_unstated_unit_is_tums_with_a_remark(tmp_path, caplog):
    folder = write_folder(tmp_path / "a", 1)
    save_camera(folder / "camera.yaml", CAMERA)
    depth = load_depth_folder(folder).views[0].depth_m
    np.testing.assert_allclose(depth[20], np.linspace(0.2, 0.6, 64), atol=2e-4)
    assert "does not say the unit of its depth maps" in caplog.text


def test_maps_of_another_camera_are_turned_to_the_colour_camera(tmp_path):
    folder = tmp_path / "seq-01"
    folder.mkdir()
    image = np.zeros((480, 640, 3), np.uint8)
    cv2.imwrite(str(folder / "frame-000000.color.png"), image)
    cv2.imwrite(str(folder / "frame-000000.depth.png"), np.full((480, 640), 2000, np.uint16))
    view = load_depth_folder(folder, width=640).views[0]
    # 585 px of the depth camera are 525 px of the colour camera: the wall ends 640/2 * 525/585 px from the centre.
    columns = np.flatnonzero((view.depth_m > 0).any(axis=0))
    assert np.ptp(columns) == pytest.approx(640 * 525 / 585, abs=6)
    assert np.median(view.depth_m[view.depth_m > 0]) == pytest.approx(2.0, abs=0.02)


def test_images_of_another_size_and_maps_without_depth_are_left_out(tmp_path):
    folder = write_folder(tmp_path / "a")
    cv2.imwrite(str(folder / "rgb" / "2.png"), np.zeros((24, 32, 3), np.uint8))
    cv2.imwrite(str(folder / "depth" / "7.png"), np.zeros((48, 64), np.uint16))
    loaded = load_depth_folder(folder)
    assert len(loaded.views) == 10
    assert "rgb/2.png: 32x24 px, calibrated for 64x48" in loaded.left_out[0]
    assert "depth/7.png: no depth between 0.05 and 30 m" in loaded.left_out[1]


def test_stamps_that_match_nothing_are_said(tmp_path):
    folder = write_folder(tmp_path / "a", 3)
    (folder / "rgb.txt").write_text("5.0 rgb/0.png\n")
    with pytest.raises(SourceError, match="no image within 0.02 s of a depth map"):
        load_depth_folder(folder)
    (folder / "rgb.txt").write_text("")
    with pytest.raises(EdgeSlamError, match="lists no image"):
        load_depth_folder(folder)


def scaled(tmp_path, line):
    """A recording whose camera file has ``line`` in place of the unit of its depth."""
    folder = write_folder(tmp_path / "a", 3)
    text = (folder / "camera.yaml").read_text().replace("depth_scale: 1000.0", line)
    (folder / "camera.yaml").write_text("%YAML:1.0\n" + text)
    return folder


@pytest.mark.parametrize("scale", ["0", "-1", "five", ".nan", "[1]"])
def test_absurd_depth_scale_is_refused(tmp_path, scale):
    with pytest.raises(EdgeSlamError, match="depth_scale must be a positive number"):
        load_depth_folder(scaled(tmp_path, f"depth_scale: {scale}"))


@pytest.mark.parametrize("key", ["DepthMapFactor", "RGBD.DepthMapFactor"])
def test_unit_of_depth_in_the_words_of_orb_slam(tmp_path, key):
    depth = load_depth_folder(scaled(tmp_path, f"{key}: 1000.0")).views[0].depth_m
    np.testing.assert_allclose(depth[20], np.linspace(1, 3, 64), atol=1e-3)


def test_reduced_image_has_reduced_intrinsics(tmp_path):
    view = load_depth_folder(write_folder(tmp_path / "a", 1), width=32).views[0]
    assert view.image.shape == (24, 32, 3)
    np.testing.assert_allclose(view.K, CAMERA.scaled(32, 24).K)


def test_folder_of_nothing_but_holes_is_refused(tmp_path):
    folder = write_folder(tmp_path / "a", 3)
    for path in (folder / "depth").iterdir():
        cv2.imwrite(str(path), np.zeros((48, 64), np.uint16))
    with pytest.raises(SourceError, match="no image with depth could be read .*no depth between"):
        load_depth_folder(folder)


@pytest.mark.parametrize("stamp", ["nan", "inf", "later"])
def test_stamp_that_is_no_number_is_left_out(tmp_path, stamp):
    folder = write_folder(tmp_path / "a", 3)
    with (folder / "rgb.txt").open("a") as file:
        file.write(f"{stamp} rgb/0.png\n")
    loaded = load_depth_folder(folder)
    assert len(loaded.views) == 3 and "rgb.txt:5" in loaded.left_out[0]
