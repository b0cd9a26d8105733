"""An unknown camera gets its focal length from the recording's own images before the run starts."""

import cv2
import numpy as np
import pytest
from rendered import film, stairs_world

from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.run import settle_camera

CAMERA = Camera(320, 240, 300.0, 300.0, 159.5, 119.5)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """16 images of panels at many depths, without a calibration."""
    rng = np.random.default_rng(8)
    steps = np.cumsum(rng.normal(0.0, 1.0, (16, 6)) * [0.09, 0.07, 0.03, 0.02, 0.03, 0.03], axis=0)
    folder = tmp_path_factory.mktemp("unknown")
    for frame in film(stairs_world(), CAMERA, np.stack([se3.exp(xi) for xi in steps - steps.mean(0)])).frames:
        assert cv2.imwrite(str(folder / f"{frame.index:04d}.png"), frame.image)
    return folder


def test_guess_is_replaced_and_said(recording):
    source = open_source(recording)
    assert source.camera.source.startswith("guess")
    settle_camera(source)
    assert source.camera.source.startswith("focal from the fundamental matrix")
    assert source.camera.fx == pytest.approx(300.0, rel=0.2)
    assert not any("guessing" in w for w in source.warnings)
    assert sum(source.camera.source in w for w in source.warnings) == 1
    assert len(list(source.frames())) == 16  # looking at them has not used them up


def test_too_few_images_keep_the_guess_and_its_warning(recording):
    source = open_source(recording, max_frames=2)
    settle_camera(source)
    assert source.camera.fx == 384.0
    assert "image pairs usable" in source.camera.source
    assert any("guessing a focal length of 384 px" in w for w in source.warnings)


@pytest.mark.parametrize(("given", "is_live"), [("kinect", False), (None, True)])
def test_a_given_camera_and_a_live_source_are_not_touched(recording, given, is_live):
    source = open_source(recording, given)
    source.live = is_live
    before = source.camera
    settle_camera(source)
    assert source.camera is before
