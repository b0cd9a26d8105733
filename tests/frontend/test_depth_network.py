"""The depth stage: metres for the camera at hand, at the image's size, on one thread."""

import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.frontend.depth_network import DepthPredictor
from edgeslam_torch.frontend.network_input import network_size, preprocess
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.models.checkpoint import build_network, save_checkpoint
from edgeslam_torch.models.fastdepth import Variant
from edgeslam_torch.models.record import Metadata

CAMERA = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
METADATA = Metadata(variant=Variant.PRUNED.value, input_height=96, input_width=128, focal_px=105.0)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    save_checkpoint(build_network(METADATA).eval(), METADATA, path)
    return path


@pytest.fixture
def image(rng):
    return cv2.resize(rng.integers(0, 256, (15, 20, 3), np.uint8), (160, 120), interpolation=cv2.INTER_CUBIC)


def test_backends_agree(weights, image):
    a, b = (DepthPredictor(weights, backend)(image, CAMERA) for backend in ("onnxruntime", "torch"))
    np.testing.assert_allclose(a.depth_m, b.depth_m, rtol=1e-4)
    np.testing.assert_allclose(a.sigma_log, b.sigma_log, rtol=1e-3)


@pytest.mark.parametrize("size", [(480, 640), (480, 752), (720, 960), (1080, 1920), (640, 480), (240, 320)])
def test_network_input_has_the_images_shape_at_the_training_area(size):
    metadata = Metadata(input_height=192, input_width=256)
    h, w = network_size(*size, (metadata.input_height, metadata.input_width))
    assert h % 32 == 0
    assert w % 32 == 0
    assert 0.6 * 192 * 256 <= h * w <= 192 * 256
    assert abs(np.log((w / h) / (size[1] / size[0]))) < 0.12


def test_falls_back_to_torch_without_onnxruntime(weights, image, monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    predictor = DepthPredictor(weights)
    assert predictor.backend == "torch"
    assert "onnxruntime is not installed" in caplog.text
    assert predictor(image, CAMERA).depth_m.shape == (120, 160)


def test_onnxruntime_backend_never_imports_torch(weights):
    program = (
        "import sys; from pathlib import Path; from edgeslam_torch.frontend.depth_network import DepthPredictor;"
        f"DepthPredictor(Path({str(weights)!r})); sys.exit('torch' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


@pytest.mark.data
@pytest.mark.parametrize(
    ("folder", "stride", "scaled", "metric"), [("tum_fr1_xyz", 20, 0.10, 0.12), ("7scenes_redkitchen", 40, 0.23, 0.32)]
)
def test_shipped_weights_on_rooms_they_were_not_trained_on(data_dir, folder, stride, scaled, metric):
    """A loose bound above the model card's figures: detects broken preprocessing or a wrong focal length."""
    from edgeslam_torch.train.views.datasets import load_depth_folder

    predictor = DepthPredictor()
    errors = []
    for view in load_depth_folder(data_dir / folder, width=640, stride=stride).views:
        K = view.K
        h, w = view.depth_m.shape
        z = predictor(view.image, Camera(w, h, K[0, 0], K[1, 1], K[0, 2], K[1, 2])).depth_m
        m = (view.depth_m > 0.1) & (view.depth_m < 10)
        ratio = np.median(view.depth_m[m]) / np.median(z[m])
        errors.append([np.abs(z[m] * s / view.depth_m[m] - 1).mean() for s in (ratio, 1.0)])
    mean = np.mean(errors, axis=0)
    assert mean[0] < scaled
    assert mean[1] < metric


# -- weights that give no depth ------------------------------------------------------------------------------------


def changed(tmp_path, metadata=METADATA, **tensors):
    """A network of which some tensors (``__`` for dots) hold one value everywhere."""
    torch.manual_seed(0)
    network = build_network(metadata).eval()
    state = network.state_dict()
    for name, value in tensors.items():
        state[name.replace("__", ".")].fill_(value)
    network.load_state_dict(state)
    save_checkpoint(network, metadata, tmp_path / "w.safetensors")
    return tmp_path / "w.safetensors"


@pytest.mark.parametrize("backend", ["onnxruntime", "torch"])
def test_weights_without_depth_are_rejected_on_loading(tmp_path, backend):
    upstream = replace(METADATA, output="depth", uncertainty=False, sigma_floor=0.2)
    for metadata, tensors, said in (
        (METADATA, {"decode_conv6__1__bias": 1e5}, "no depth"),
        (upstream, {"decode_conv6__1__bias": -1.0}, "no depth"),  # ReLU of a negative number
        (METADATA, {"decode_conv6__0__weight": 0.0, "decode_conv6__1__bias": 1.0}, "the same depth"),
    ):
        with pytest.raises(WeightsError, match=rf"w\.safetensors: gives {said}"):
            DepthPredictor(changed(tmp_path, metadata, **tensors), backend)


@pytest.mark.parametrize("backend", ["onnxruntime", "torch"])
def test_depth_has_the_images_size_and_is_positive(weights, image, backend):
    predictor = DepthPredictor(weights, backend)
    depth = predictor(image, CAMERA)
    assert predictor.backend == backend
    for field in (depth.depth_m, depth.sigma_log):
        assert field.shape == (120, 160)
        assert field.dtype == np.float32
        assert (field > 0).all()


def test_depth_follows_the_focal_length(weights, image):
    """The same pixels through a lens 1.2 times as long are 1.2 times as far away."""
    predictor = DepthPredictor(weights)
    long = predictor(image, replace(CAMERA, fx=1.2 * CAMERA.fx, fy=1.2 * CAMERA.fy))
    np.testing.assert_allclose(long.depth_m, 1.2 * predictor(image, CAMERA).depth_m, rtol=1e-5)


def test_resolution_does_not_change_the_metres(weights, image):
    large = cv2.resize(image, (480, 360), interpolation=cv2.INTER_NEAREST)
    predictor = DepthPredictor(weights)
    a = predictor(image, CAMERA).depth_m.mean()
    assert predictor(large, CAMERA.scaled(480, 360)).depth_m.mean() == pytest.approx(a, rel=0.05)


def test_a_shrunk_image_is_not_rounded_to_grey_levels():
    """Processors round a mean between two levels differently, and hence would see other depths."""
    image = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    mean = image.reshape(32, 2, 48, 2, 3).mean(axis=(1, 3))
    assert np.mean(mean % 1.0 == 0.5) > 0.1
    x = preprocess(image, 32, 48, Metadata())
    np.testing.assert_allclose(x[0], np.moveaxis(mean[:, :, ::-1], 2, 0) / 127.5 - 1.0, atol=1e-6)


def test_wrong_size_backend_and_files_are_rejected(weights, image, tmp_path):
    with pytest.raises(ValueError, match="does not fit"):
        DepthPredictor(weights)(image[:60], CAMERA)
    with pytest.raises(ValueError, match="backend"):
        DepthPredictor(weights, "tensorflow")
    with pytest.raises(WeightsError, match="no such weights"):
        DepthPredictor(tmp_path / "none.safetensors")
    (tmp_path / "bad.onnx").write_bytes(b"not an onnx file")
    with pytest.raises(WeightsError, match=r"bad\.onnx"):
        DepthPredictor(tmp_path / "bad.onnx")
