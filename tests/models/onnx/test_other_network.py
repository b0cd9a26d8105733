"""A depth network other than FastDepth is an ONNX file with our inputs, outputs and record (CONTRIBUTING.md)."""

import json
from dataclasses import asdict

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from small_depth import narrow_fastdepth

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.frontend.depth_network import DepthPredictor
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.models.checkpoint import save_checkpoint
from edgeslam_torch.models.record import OTHER_NETWORK, Metadata

GREEN = Metadata(
    variant=OTHER_NETWORK, input_height=64, input_width=96, focal_px=80.0, mean=(0.0, 0.0, 0.0), std=(1.0, 1.0, 1.0)
)
"""Takes RGB in [0, 1]; its metres hold for 80 px of focal length at a width of 96."""


def write_green_network(path, metres=3.0):
    """A network that maps green to depth: ``1 + metres green``, 10 % sure of it, at half the image's size."""
    constants = {"green": [[[[0.0]], [[metres]], [[0.0]]]], "one": [1.0], "none": 0.0, "sigma": 0.1}
    nodes = [
        helper.make_node("Conv", ["image", "green", "one"], ["depth"]),
        helper.make_node("AveragePool", ["depth"], ["half"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Log", ["half"], ["log_depth"]),
        helper.make_node("Mul", ["half", "none"], ["zero"]),
        helper.make_node("Add", ["zero", "sigma"], ["sigma_log"]),
    ]
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        "green",
        [value("image", TensorProto.FLOAT, [1, 3, "H", "W"])],
        [value(name, TensorProto.FLOAT, [1, 1, "h", "w"]) for name in ("log_depth", "sigma_log")],
        [numpy_helper.from_array(np.array(x, np.float32), name) for name, x in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {"edgeslam": json.dumps(asdict(GREEN))})
    onnx.save(model, str(path))
    return path


def test_other_network_gives_the_slam_metres_for_its_camera(tmp_path):
    predict = DepthPredictor(write_green_network(tmp_path / "green.onnx"))
    assert predict.metadata.variant == OTHER_NETWORK
    image = np.zeros((128, 192, 3), np.uint8)
    image[:, 96:, 1] = 255
    depth = predict(image, Camera(192, 128, 320.0, 320.0, 95.5, 63.5))  # a lens of twice the focal length
    np.testing.assert_allclose(depth.depth_m[:, :80], 2.0, rtol=1e-5)
    np.testing.assert_allclose(depth.depth_m[:, 112:], 8.0, rtol=1e-5)
    np.testing.assert_allclose(depth.sigma_log, 0.1, rtol=1e-5)


def test_weights_without_a_graph_cannot_be_another_network(tmp_path):
    save_checkpoint(narrow_fastdepth(), GREEN, tmp_path / "w.safetensors")
    with pytest.raises(WeightsError, match="other networks come as ONNX files"):
        DepthPredictor(tmp_path / "w.safetensors")
