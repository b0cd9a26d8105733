"""Every kind of source, good and bad."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from edgeslam_torch.errors import CalibrationError, SourceError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.types import TelemetrySample


def test_tum_folder(tmp_path, write_tum):
    folder = write_tum(tmp_path / "seq", 5)
    (folder / "groundtruth.txt").write_text("")
    save_camera(folder / "camera.yaml", Camera(64, 48, 50.0, 50.0, 31.5, 23.5))
    source = open_source(folder)
    frames = list(source.frames())
    assert [f.index for f in frames] == [0, 1, 2, 3, 4]
    assert frames[3].stamp_s == pytest.approx(100.3)
    assert frames[0].image.shape == (48, 64)
    assert (source.kind, source.length, source.problems, source.warnings) == ("tum", 5, [], [])
    assert source.groundtruth == folder / "groundtruth.txt"
    assert source.camera.fx == 50.0
    assert "camera.yaml" in source.camera.source


def test_seven_scenes_as_published(tmp_path, write_images):
    folder = tmp_path / "seq-01"
    write_images(folder, [f"frame-{i:06d}.{kind}.png" for i in range(3) for kind in ("color", "depth")], (640, 480))
    np.savetxt(folder / "frame-000000.pose.txt", np.eye(4))
    source = open_source(folder)
    assert source.kind == "7scenes"
    assert [round(30 * f.stamp_s) for f in source.frames()] == [0, 1, 2]
    assert source.camera.fx == 525.0
    assert source.groundtruth == folder
    assert "7-Scenes" in source.warnings[0]


@pytest.mark.parametrize("level", ["", "mav0", "mav0/cam0"])
def test_euroc_as_published(tmp_path, write_images, level):
    cam = tmp_path / "mav0" / "cam0"
    stamps = [1403636579763555584 + i * 50_000_000 for i in range(3)]
    write_images(cam / "data", [f"{s}.png" for s in stamps], (752, 480))
    cam.joinpath("data.csv").write_text("#timestamp [ns],filename\r\n" + "".join(f"{s},{s}.png\r\n" for s in stamps))
    cam.joinpath("sensor.yaml").write_text(
        "sensor_type: camera\nresolution: [752, 480]\ncamera_model: pinhole\n"
        "intrinsics: [458.654, 457.296, 367.215, 248.375]\ndistortion_model: radial-tangential\n"
        "distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]\n"
    )
    truth = tmp_path / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    truth.parent.mkdir()
    truth.write_text("")
    source = open_source(tmp_path / level)
    frames = list(source.frames())
    assert source.kind == "euroc"
    assert frames[1].stamp_s - frames[0].stamp_s == pytest.approx(0.05, abs=1e-6)
    assert source.camera.fx == 458.654
    assert source.camera.distortion[0] == -0.28340811
    assert source.groundtruth == truth


def test_image_folder_in_numeric_order_at_30_hz(tmp_path, write_images):
    write_images(tmp_path, [f"img{i}.jpg" for i in (1, 2, 10, 9)])
    (tmp_path / "notes.txt").write_text("x")
    source = open_source(tmp_path)
    frames = list(source.frames())
    assert [f.path.name for f in frames] == ["img1.jpg", "img2.jpg", "img9.jpg", "img10.jpg"]
    assert [f.stamp_s for f in frames] == pytest.approx([0, 1 / 30, 2 / 30, 3 / 30])
    assert "guess" in source.camera.source
    assert source.camera.focal_sigma > 0.3
    assert "bends the trajectory" in source.warnings[0]
    assert any("30 images/s" in problem.reason for problem in source.problems)


@pytest.mark.parametrize(
    ("names", "gap"),
    [
        (["1305031102.175304.png", "1305031102.211214.png"], 0.03591),
        (["1403636579763555584.png", "1403636579813555456.png"], 0.05),
        (["000010.png", "000011.png"], 1 / 30),
        (["0.0.png", "0.05.png", "0.1.png"], 0.05),
    ],
)
def test_stamps_from_file_names(tmp_path, write_images, names, gap):
    write_images(tmp_path, names)
    frames = list(open_source(tmp_path).frames())
    assert frames[1].stamp_s - frames[0].stamp_s == pytest.approx(gap, abs=1e-5)


@pytest.fixture
def video(tmp_path, rng):
    path = tmp_path / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 25.0, (64, 48))
    for _ in range(8):
        writer.write(rng.integers(0, 256, (48, 64, 3), dtype=np.uint8))
    writer.release()
    return path


def test_cut_off_video_gives_what_it_has(video):
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    source = open_source(video)
    assert len(list(source.frames())) + sum(problem.frames for problem in source.problems) == 8
    assert source.problems[-1].reason.endswith("of 8 frames; the file is damaged")


# -- images that cannot be used ----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("damage", ["empty", "truncated", "garbage", "missing"])
def test_unusable_image_is_left_out_and_leaves_a_gap(tmp_path, write_images, suffix, damage):
    names = [f"{i}{suffix}" for i in range(4)]
    paths = write_images(tmp_path / "rgb", names)
    (tmp_path / "rgb.txt").write_text("".join(f"{0.1 * i} rgb/{n}\n" for i, n in enumerate(names)))
    if damage == "missing":
        paths[2].unlink()
    else:
        whole = paths[2].read_bytes()
        paths[2].write_bytes({"empty": b"", "truncated": whole[: len(whole) // 2], "garbage": b"hello" * 99}[damage])
    source = open_source(tmp_path)
    assert [f.index for f in source.frames()] == [0, 1, 3]
    assert [p.file for p in source.problems] == [str(paths[2])]


# -- sources that cannot be used ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("files", "source", "said"),
    [
        ({"letter.docx": b"x"}, "", r"found \.docx"),
        ({"desk/rgb.txt": b"0.0 rgb/1.png\n", "desk/rgb/1.png": b"x"}, "", "desk"),
        ({"rgb.txt": b"# nothing\n", "rgb/1.png": b"x"}, "", "lists no image"),
        ({"rgb.txt": bytes(range(256))}, "", "rgb.txt"),
        ({"1.png": b"nonsense", "2.png": b"nonsense"}, "", "none of its images can be read.*1.png"),
        ({"a.zip": b"x"}, "a.zip", "unpack"),
        ({"a.insv": b"x"}, "a.insv", "export a flat video"),
        ({"a.360": b"x"}, "a.360", "export a flat video"),
        ({"tum_fr1_xyz/1.png": b"x"}, "tum_fr1_xy", r"no such file or folder; did you mean .*tum_fr1_xyz\?"),
        ({"a.pdf": b"x"}, "a.pdf", "not a folder of images"),
        ({"clip.mp4": b""}, "clip.mp4", "clip.mp4"),
        ({"clip.mp4": b"not a video at all" * 50}, "clip.mp4", "clip.mp4"),
    ],
)
def test_what_is_no_source_is_refused_with_the_reason(tmp_path, files, source, said):
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
    with pytest.raises(SourceError, match=said):
        open_source(tmp_path / source)


def write_y4m(path, count):
    """YUV4MPEG2, which needs no encoder."""
    frame = b"FRAME\n" + np.random.default_rng(0).integers(0, 255, 64 * 48 * 3 // 2, dtype=np.uint8).tobytes()
    path.write_bytes(b"YUV4MPEG2 W64 H48 F30:1 Ip A1:1 C420jpeg\n" + count * frame)


@pytest.mark.parametrize("suffix", [".y4m", ".mts", ".lrv", ".3gp", ".hevc", ".H265", ".m2ts"])
def test_names_of_videos(tmp_path, suffix):
    """FFmpeg goes by the content; the name only tells that it is a video."""
    path = tmp_path / f"clip{suffix}"
    write_y4m(path, 5)
    source = open_source(path)
    assert [round(frame.stamp_s, 3) for frame in source.frames()] == [0.0, 0.033, 0.067, 0.1, 0.133]
    raw = suffix.lower() in (".hevc", ".h265")
    assert any("are assumed" in problem.reason for problem in source.problems) == raw
    assert open_source(tmp_path).kind == "video"


def test_an_imu_beside_the_images_is_used_unless_the_user_says_otherwise(tmp_path, write_tum):
    folder = write_tum(tmp_path / "seq", 5)
    rows = [f"{100 + 0.005 * i:.3f},0,0,0.1,0,0,9.81" for i in range(80)]
    (folder / "imu.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "other.csv").write_text("\n".join(rows[10:]) + "\n")
    own, none, other = (open_source(folder, imu=imu) for imu in (None, "none", tmp_path / "other.csv"))
    assert len(own.imu_readings) == 80 and own.imu.rate_hz == pytest.approx(200)
    assert none.imu is None and none.imu_readings is None and not none.warnings[1:]
    assert len(other.imu_readings) == 70
    given = [reading for _, readings in own.steps() for reading in readings]
    assert sum(map(len, given)) == 80
    told = replace(own, telemetry=[TelemetrySample(s) for s in (98.0, 99.0, 99.4, 100.3)])
    part = told.part(3, 1)  # from 100.3 s on
    assert part.imu_readings.stamps_s[0] >= 99.3
    assert [sample.stamp_s for sample in part.telemetry] == [99.4, 100.3]
    with pytest.raises(SourceError, match=r"--imu .*gone\.csv: no such file"):
        open_source(folder, imu=tmp_path / "gone.csv")


@pytest.mark.parametrize("start", [0, 3])
@pytest.mark.parametrize("stride", [1, 4])
@pytest.mark.parametrize("most", [None, 2, 99])
def test_the_length_of_a_part_is_the_number_of_its_frames(tmp_path, write_tum, start, stride, most):
    part = open_source(write_tum(tmp_path / "seq", 12), max_frames=most).part(start, stride)
    assert part.length == len(list(part.frames()))


def test_seven_scenes_frame_that_is_there_twice_is_used_once(tmp_path, write_images):
    names = ["frame-000000.color.png", "frame-000001.color.png", "frame-000001.color.jpg", "frame-²2.color.png"]
    write_images(tmp_path, names, (640, 480))
    source = open_source(tmp_path)
    assert [round(30 * f.stamp_s) for f in source.frames()] == [0, 1]
    assert [p.frames for p in source.problems] == [1, 1]


@pytest.mark.parametrize(("stamps", "seconds"), [([5.0, 5.1, 5.3], [5.0, 5.1, 5.3]), ([0, 50_000_000], [0.0, 0.05])])
def test_a_video_has_the_stamps_of_the_file_beside_it_also_nanoseconds(tmp_path, stamps, seconds):
    write_y4m(tmp_path / "clip.y4m", len(stamps))
    (tmp_path / "clip_stamps.txt").write_text("".join(f"{stamp} {i}\n" for i, stamp in enumerate(stamps)))
    assert [frame.stamp_s for frame in open_source(tmp_path).frames()] == pytest.approx(seconds)


def test_video_of_too_many_pixels_is_refused(video, monkeypatch):
    monkeypatch.setattr("edgeslam_torch.readers.images.MAX_PIXELS", 64 * 48 - 1)
    with pytest.raises(SourceError, match="clip.avi: image is 64x48, more than"):
        open_source(video)


def test_malformed_lines_of_a_list_are_named(tmp_path, write_tum):
    folder = write_tum(tmp_path, 3)
    with (folder / "rgb.txt").open("a") as file:
        file.write("what is this\n101.0\nnan rgb/x.png\n")
    source = open_source(folder)
    assert source.length == 3
    assert len(source.problems) == 3
    assert source.problems[0].file.endswith("rgb.txt:5")


def test_one_image_is_a_source(tmp_path, write_images):
    (path,) = write_images(tmp_path, ["only.png"])
    assert [f.index for f in open_source(path).frames()] == [0]


def test_given_calibration_wins_is_scaled_to_the_images_and_refused_for_another_shape(tmp_path, write_tum):
    folder = write_tum(tmp_path / "a", 2, (320, 240))
    save_camera(folder / "camera.yaml", Camera(320, 240, 50.0, 50.0, 160.0, 120.0))
    source = open_source(folder, camera="kinect")
    assert source.camera.fx == pytest.approx(262.5)
    assert "scaled from 640x480 to 320x240" in source.camera.source and source.warnings
    with pytest.raises(CalibrationError, match="640x480.*960x540"):
        open_source(write_tum(tmp_path / "b", 2, (960, 540)), camera="kinect")


def test_the_small_copy_beside_a_video_is_no_second_one(tmp_path):
    write_y4m(tmp_path / "GX010001.mp4", 3)
    write_y4m(tmp_path / "GL010001.lrv", 2)
    assert len(list(open_source(tmp_path).frames())) == 3


@pytest.mark.parametrize("size", [(1, 1), (640, 8), (16, 480)])
def test_images_too_small_to_be_tracked_are_refused(tmp_path, write_images, size):
    write_images(tmp_path, ["1.png", "2.png"], size)
    with pytest.raises(SourceError, match="too small"):
        open_source(tmp_path)


def test_a_picture_beside_the_folder_of_images_is_not_the_recording(tmp_path, write_images):
    write_images(tmp_path, ["title.png"])
    write_images(tmp_path / "frames", [f"{i}.png" for i in range(5)])
    with pytest.raises(SourceError, match="5 in its folder frames"):
        open_source(tmp_path)


def test_lens_that_turns_back_in_the_corners_is_used_with_a_warning(tmp_path, write_tum):
    folder = write_tum(tmp_path, 2)
    save_camera(folder / "camera.yaml", Camera(64, 48, 40.0, 40.0, 31.5, 23.5, (-0.3, 0.0, 0.0, 0.0, 0.0)))
    assert "turns back at 70 % of the way to the border" in open_source(folder).warnings[0]
