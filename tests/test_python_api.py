"""What a Python user gives to the system and sees of it."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from edgeslam_torch import Camera, EdgeSlam, Frame, SlamConfig, TelemetrySample, run
from edgeslam_torch.config import DepthConfig
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.readers.source import open_source

CAMERA = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
NO_NETWORK = SlamConfig(depth=DepthConfig(weights="none"))
RGB = np.random.default_rng(0).integers(0, 256, (48, 64, 3), dtype=np.uint8)
BGR = Frame(0, 0.0, RGB[..., ::-1].copy())


@pytest.mark.parametrize(
    "image",
    [
        RGB,
        RGB / 255.0,
        (RGB / 255.0).astype(np.float32).transpose(2, 0, 1),
        torch.from_numpy(RGB),
        torch.from_numpy(RGB).permute(2, 0, 1),
        (torch.from_numpy(RGB).permute(2, 0, 1) / 255.0).requires_grad_(),
    ],
)
def test_rgb_of_any_kind_becomes_the_same_frame(image):
    frame = Frame.from_rgb(0, 0.0, image)
    assert frame.image.dtype == np.uint8 and np.array_equal(frame.image, BGR.image)


@pytest.mark.parametrize("image", [RGB * 1.0, np.full((48, 64), np.nan), RGB[..., :2], RGB.astype(np.int16), [[1]], {}])
def test_what_is_no_rgb_image_is_refused(image):
    with pytest.raises((TypeError, ValueError), match="image"):
        Frame.from_rgb(0, 0.0, image)


@pytest.mark.parametrize(
    "frame",
    [
        {"image": RGB},
        RGB,
        Frame(0, 0.0, RGB / 255.0),
        Frame(0, 0.0, torch.from_numpy(RGB)),
        Frame(0, 0.0, RGB.transpose(2, 0, 1)),
        Frame(0, 0.0, None),
        Frame(0, 0.0, RGB[:0]),
        Frame(0, float("nan"), RGB),
    ],
)
def test_what_is_no_frame_is_refused_at_once(frame):
    with EdgeSlam(CAMERA, NO_NETWORK) as slam:
        for call in (slam.step, slam.prepare):
            with pytest.raises((TypeError, ValueError), match=r"Frame\(index|Frame.from_rgb|finite"):
                call(frame)
        assert slam.step(BGR).index == 0


@pytest.mark.parametrize(
    "telemetry",
    [{"stamp_s": 0.0}, None, TelemetrySample(0.0), [{}], np.zeros(3), [TelemetrySample(0.0, velocity_m_s=(1, 2))]],
)
def test_what_is_no_telemetry_is_refused_at_once(telemetry):
    slam = EdgeSlam(CAMERA, NO_NETWORK)
    with pytest.raises((TypeError, ValueError), match="telemetry|readings"):
        slam.step(BGR, telemetry)


@pytest.mark.parametrize("source", ["recordings/fr1", None, {"path": "recordings/fr1"}])
def test_what_is_no_source_is_refused_before_anything_is_written(tmp_path, source):
    with pytest.raises(TypeError, match=r"a source is expected, got \w+: open_source\("):
        run(source, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_settings_that_are_none_are_refused_before_anything_is_written(tmp_path, write_tum):
    write_tum(tmp_path / "recording", 3)
    with pytest.raises(TypeError, match="a SlamConfig is expected, got dict"):
        run(open_source(tmp_path / "recording"), tmp_path / "out", {"orb": {}})
    assert not (tmp_path / "out").exists()


def test_steps_pair_each_frame_with_the_telemetry_since_the_last(tmp_path, write_images):
    write_images(tmp_path, [f"{k}.png" for k in range(4)])
    save_camera(tmp_path / "camera.yaml", CAMERA)
    (tmp_path / "telemetry.csv").write_text("stamp_s,bat\n" + "".join(f"{0.01 * k:.3f},{k}\n" for k in range(9)))
    source = open_source(tmp_path)
    steps = list(source.steps())
    assert [f.index for f, _ in steps] == [f.index for f in source.frames()]
    stamps = [sample.stamp_s for _, samples in steps for sample in samples]
    assert stamps == [s.stamp_s for s in source.telemetry if s.stamp_s <= steps[-1][0].stamp_s]
    assert all(sample.stamp_s <= frame.stamp_s for frame, samples in steps for sample in samples)
    assert "telemetry" in repr(source) and len(repr(source)) < 200


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="counts threads by /proc")
@pytest.mark.parametrize(
    ("wanted", "threads"), [({}, 1), pytest.param({"OPENBLAS_NUM_THREADS": "2"}, 2, marks=pytest.mark.slow)]
)
def test_linear_algebra_takes_one_thread_unless_the_user_wants_more(wanted, threads):
    code = "import edgeslam_torch.slam, os; print(len(os.listdir('/proc/self/task')))"
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")} | wanted
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    assert (int(done.stdout) > 1) == (threads > 1)
