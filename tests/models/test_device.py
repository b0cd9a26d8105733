"""The device that is asked for is the one that computes, or one line says why not."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_depth import narrow_fastdepth

from edgeslam_torch.config import DepthConfig
from edgeslam_torch.errors import ConfigError
from edgeslam_torch.frontend.depth_network import DepthPredictor, open_depth
from edgeslam_torch.frontend.onnx_session import open_session
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.models.checkpoint import save_checkpoint
from edgeslam_torch.models.device import find_device, onnx_providers
from edgeslam_torch.models.onnx.fold import deployed
from edgeslam_torch.models.record import Metadata

METADATA = Metadata(input_height=64, input_width=96, focal_px=80.0)
CAMERA = Camera(96, 64, 80.0, 80.0, 47.5, 31.5)
CUDA, CPU = "CUDAExecutionProvider", "CPUExecutionProvider"


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    save_checkpoint(narrow_fastdepth(METADATA), METADATA, path)
    return path


@pytest.fixture
def image():
    return np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)


def without_gpu(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)


def onnxruntime_with(monkeypatch, *built_in, usable=CPU):
    """An onnxruntime that was built with some providers, of which only one works; what it is asked for."""
    asked = []

    def session(content, options, providers):
        asked.append(providers)
        return SimpleNamespace(get_providers=lambda: [usable])

    fake = SimpleNamespace(
        __version__="1.99",
        __spec__=SimpleNamespace(),
        get_available_providers=lambda: [*built_in],
        InferenceSession=session,
        SessionOptions=SimpleNamespace,
    )
    monkeypatch.setitem(sys.modules, "onnxruntime", fake)
    return asked


@pytest.mark.parametrize("device", ["cuda", "mps"])
@pytest.mark.parametrize("backend", ["onnxruntime", "torch"])
def test_a_device_that_is_not_there_is_refused_and_not_replaced(weights, backend, device, monkeypatch):
    without_gpu(monkeypatch)
    with pytest.raises(ConfigError, match=rf"--device {device}: .*no such device; use --device cpu"):
        open_depth(weights, backend, device=device)


@pytest.mark.parametrize(
    ("device", "built_in", "asked"),
    [("cpu", (CUDA, CPU), [CPU]), ("auto", (CPU,), [CPU]), ("auto", (CUDA, CPU), [CUDA, CPU]),
     ("cuda", (CUDA, CPU), [CUDA, CPU])],
)  # fmt: skip
def test_onnxruntime_is_asked_for_the_device(device, built_in, asked, monkeypatch):
    log = onnxruntime_with(monkeypatch, *built_in, usable=asked[0])
    open_session(b"", Path("x.onnx"), 1, device)
    assert log == [asked]


def test_a_silent_fallback_of_onnxruntime_is_reported(monkeypatch, caplog):
    """CUDA is built in, its libraries are missing: onnxruntime goes on with the processor and says nothing."""
    onnxruntime_with(monkeypatch, CUDA, CPU, usable=CPU)
    with pytest.raises(ConfigError, match=r"cannot use CUDA here .* use --device cpu"):
        open_session(b"", Path("x.onnx"), 1, "cuda")
    open_session(b"", Path("x.onnx"), 1, "auto")
    assert "depth runs on the processor" in caplog.text


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA here")
def test_cuda_gives_the_processors_depth(weights, image):
    there, here = (DepthPredictor(weights, "torch", device=device) for device in ("cuda", "cpu"))
    assert there.backend.startswith("torch on cuda")
    np.testing.assert_allclose(there(image, CAMERA).depth_m, here(image, CAMERA).depth_m, rtol=1e-3)


@pytest.mark.parametrize("device", ["gpu", "cuda:1", ""])
def test_other_names_are_refused(weights, device):
    for ask in (find_device, onnx_providers, lambda name: open_depth(weights, device=name)):
        with pytest.raises(ConfigError, match="there are auto, cpu, cuda, mps"):
            ask(device)
    with pytest.raises(ValueError, match="device must be auto, cpu, cuda or mps"):
        DepthConfig(device=device)


def test_the_deployed_network_leaves_nothing_on_the_processor():
    """On the meta device, tensors have no values: one that was left elsewhere would not go with them."""
    network = deployed(narrow_fastdepth(METADATA), METADATA).to("meta")
    log_depth, sigma = network(torch.zeros(1, 3, 64, 96, device="meta"))
    assert log_depth.shape == sigma.shape == (1, 1, 32, 48)
    assert log_depth.device.type == sigma.device.type == "meta"
