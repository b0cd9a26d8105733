"""ONNX depth networks of others: the right depth, or one line that says what is missing."""

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto
from small_networks import FAR_M, NEAR_M, RELATIVE, describe, green_network, node

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.frontend import depth_network
from edgeslam_torch.frontend.depth_check import CheckedDepth
from edgeslam_torch.frontend.depth_network import open_depth, weights_path
from edgeslam_torch.frontend.external_depth import ExternalDepth, relative_depth
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.models.onnx.presets import PRESETS, preset_file
from edgeslam_torch.models.record import weights_file
from edgeslam_torch.types import DepthMap

CAMERA = Camera(192, 128, 160.0, 160.0, 95.5, 63.5)
SIZE = "input_height = 128\ninput_width = 192\n"
GREEN = {
    "metres": {},
    "log_metres": {"nodes": [node("Log", "depth", "log")], "output": "log"},
    "inverse_metres": {"nodes": [node("Reciprocal", "depth", "inverse")], "output": "inverse"},
    "relative_inverse": RELATIVE,
}


@pytest.fixture(autouse=True)
def trial_in_this_process(monkeypatch):
    """A second less for every network; `test_onnx_trial` tries some in a process of their own."""
    monkeypatch.setattr(depth_network, "try_apart", lambda path: depth_network._open_onnx(path).try_larger())


@pytest.fixture
def image():
    """Black and green halves."""
    made = np.zeros((128, 192, 3), np.uint8)
    made[:, 96:, 1] = 255
    return made


@pytest.mark.parametrize("gives", ["metres", "log_metres", "inverse_metres"])
@pytest.mark.parametrize("plane", [False, True])
def test_every_output_type_gives_metres(tmp_path, image, gives, plane):
    path = green_network(tmp_path / "net.onnx", plane=plane, **GREEN[gives])
    network = open_depth(describe(path, f'gives = "{gives}"\nfocal_px = 80.0\n{SIZE}'))
    found = network(image, CAMERA)
    assert network.is_metric and not found.is_relative
    np.testing.assert_allclose(found.depth_m[:, :80], 2 * NEAR_M, rtol=1e-5)  # a lens of twice the focal length
    np.testing.assert_allclose(found.depth_m[:, 112:], 2 * FAR_M, rtol=1e-5)
    np.testing.assert_allclose(found.sigma_log, 0.25)


def test_relative_depth_is_right_up_to_scale_and_shift_of_its_inverse(tmp_path, rng):
    network = open_depth(
        describe(green_network(tmp_path / "n.onnx", **RELATIVE), f'gives = "relative_inverse"\n{SIZE}')
    )
    green = rng.integers(0, 256, (128, 192)).astype(np.uint8)
    found = network(np.stack([0 * green, green, 0 * green], axis=2), CAMERA)
    assert found.is_relative and not network.is_metric
    true = 1.0 / (NEAR_M + (FAR_M - NEAR_M) * green / 255.0)
    line = np.polyfit(true.ravel(), 1.0 / found.depth_m.ravel(), 1)
    assert line[0] > 0
    np.testing.assert_allclose(1.0 / found.depth_m, np.polyval(line, true), rtol=1e-4)
    assert np.median(found.depth_m) == pytest.approx(1.0, rel=1e-3)


def test_record_inside_the_file_needs_no_other(tmp_path, image):
    path = green_network(tmp_path / "net.onnx")
    model = onnx.load(str(path))
    record = {"gives": "metres", "input_height": 128, "input_width": 192}
    onnx.helper.set_model_props(model, {"edgeslam.depth": json.dumps(record)})
    onnx.save(model, str(path))
    np.testing.assert_allclose(open_depth(path)(image, CAMERA).depth_m[:, 112:], FAR_M, rtol=1e-5)


def test_input_fits_the_image_in_multiples_of_the_networks_patches(tmp_path):
    """A transformer's patches: an image of any other size cannot be run."""
    nodes = [node("Reshape", "depth patches", "cut"), node("Reshape", "cut whole", "again")]
    constants = {
        "patches": np.array([1, 1, -1, 14 * 9 * 14], np.int64),
        "whole": np.array([1, 1, -1, 14 * 9], np.int64),
    }
    path = green_network(tmp_path / "net.onnx", nodes, "again", constants=constants, size=("h", 126))
    text = 'gives = "metres"\nmultiple = 14\ninput_height = 84\n'
    network = open_depth(describe(path, text))
    assert network(np.zeros((96, 144, 3), np.uint8), Camera(144, 96, 99.0, 99.0, 71.5, 47.5)).depth_m.shape == (96, 144)


# -- one line ------------------------------------------------------------------------------------------------------

BAD = {
    "no description": None,
    "gives must be one of": "input_width = 192\n",
    "unknown key 'gife'": f'gives = "metres"\ngife = 1\n{SIZE}',
    "multiples of 14": f'gives = "metres"\nmultiple = 14\n{SIZE}',
    "std from": f'gives = "metres"\nstd = [0.0, 1.0, 1.0]\n{SIZE}',
    "no preset 'midas'": 'preset = "midas"\n',
    "no output 'inverse'": f'gives = "metres"\ndepth = "inverse"\n{SIZE}',
    "input is 'picture'": f'gives = "metres"\ninput = "picture"\n{SIZE}',
    "not valid TOML": "gives =\n",
    "sigma_log must be from": f'gives = "metres"\nsigma_log = 0.0\n{SIZE}',
}


@pytest.mark.parametrize("words", BAD)
def test_bad_description_is_one_line(tmp_path, words):
    path = green_network(tmp_path / "net.onnx")
    if BAD[words] is not None:
        describe(path, BAD[words])
    with pytest.raises(WeightsError, match=words) as caught:
        open_depth(path)
    assert "\n" not in str(caught.value) and "net." in str(caught.value)


# -- presets -------------------------------------------------------------------------------------------------------

SIGNATURES = {
    "depth-anything-v2-small": {**RELATIVE, "input": "pixel_values", "plane": True},
    "depth-anything-v2-small-indoor": {"plane": True},
    "midas-small": {**RELATIVE, "input": "0", "size": (256, 256), "plane": True},
    "metric3d-v2-small": {
        "nodes": (node("Identity", "depth", "predicted_depth"), node("Identity", "depth", "predicted_normal")),
        "input": "pixel_values",
        "output": "predicted_normal predicted_depth",
    },
}
"""Inputs, outputs and sizes as the published files have them."""


@pytest.mark.parametrize("name", PRESETS)
def test_preset_runs_a_graph_of_its_networks_signature(tmp_path, monkeypatch, name):
    image = np.zeros((128, 192, 3), np.uint8)
    image[..., 1] = np.where(np.arange(192) < 96, 128, 255)
    monkeypatch.setenv("EDGESLAM_CACHE", str(tmp_path))
    with pytest.raises(WeightsError, match=f"edgeslam weights download {name}"):
        weights_path(name)
    describe(green_network(preset_file(name), **SIGNATURES[name]), f'preset = "{name}"\n')
    network = open_depth(weights_path(name))
    assert isinstance(network, ExternalDepth) and network.is_metric == ("metres" in PRESETS[name].remote.about)
    found = network(image, CAMERA)
    assert found.depth_m[:, 112:].mean() > 1.5 * found.depth_m[:, :80].mean() > 0


def test_weights_that_come_with_the_package_have_names(image):
    near, usual = (open_depth(weights_path(name)) for name in ("near", "default"))
    assert near.is_metric
    assert "hololens_a" in near.metadata.data and "hololens_a" not in usual.metadata.data
    apart = np.log(near(image, CAMERA).depth_m / usual(image, CAMERA).depth_m)
    assert 1e-3 < np.abs(apart).mean() < 2.0
    assert weights_file("near") == weights_path("near")
    assert weights_file("a/b.safetensors") == Path("a/b.safetensors")


@pytest.mark.parametrize(
    ("numbers", "described"),
    [
        ("metres", "relative_inverse"),
        ("metres", "inverse_metres"),
        ("log_metres", "relative_inverse"),
        ("inverse_metres", "metres"),
        ("relative_inverse", "metres"),
        ("metres", "log_metres"),
        ("log_metres", "metres"),
        *[(right, right) for right in ("metres", "log_metres", "inverse_metres", "relative_inverse")],
    ],
)
def test_the_output_type_is_inferred_from_a_reference(tmp_path, image, numbers, described):
    path = describe(green_network(tmp_path / "net.onnx", **GREEN[numbers]), f'gives = "{described}"\n{SIZE}')
    network = ExternalDepth(path)
    truth = NEAR_M + (FAR_M - NEAR_M) * image[..., 1].astype(np.float32) / 255
    said = network.contradiction(network(image, CAMERA), image, CAMERA, DepthMap(1.4 * truth, np.ones_like(truth)))
    assert (said == "") if numbers == described else (f"gives = '{numbers}'" in said)


@pytest.mark.parametrize(
    ("numbers", "size", "last"),
    [
        (TensorProto.FLOAT, ("h", "w"), True),
        (TensorProto.FLOAT16, (128, 192), False),
        (TensorProto.DOUBLE, ("h", "w"), False),
        (TensorProto.UINT8, (128, 192), True),
    ],
)
def test_input_has_the_graphs_data_type_and_layout(tmp_path, image, numbers, size, last):
    path = green_network(tmp_path / "net.onnx", numbers=numbers, last=last, size=size)
    found = open_depth(describe(path, f'gives = "metres"\n{SIZE}'))(image, CAMERA)
    np.testing.assert_allclose(found.depth_m[:, :80], NEAR_M, rtol=1e-3)
    np.testing.assert_allclose(found.depth_m[:, 112:], FAR_M, rtol=1e-3)


def test_only_external_data_beside_the_file_is_read(tmp_path, image):
    whole = onnx.load(green_network(tmp_path / "whole.onnx"))
    path = tmp_path / "net.onnx"
    onnx.save(whole, path, save_as_external_data=True, location="net.onnx.data", size_threshold=0)
    describe(path, f'gives = "metres"\n{SIZE}')
    np.testing.assert_allclose(open_depth(path)(image, CAMERA).depth_m[:, 112:], FAR_M, rtol=1e-5)
    (tmp_path / "net.onnx.data").rename(tmp_path.parent / "net.onnx.data")
    with pytest.raises(WeightsError, match="no such"):
        open_depth(path)
    model = onnx.load(path, load_external_data=False)
    for entry in (entry for tensor in model.graph.initializer for entry in tensor.external_data):
        entry.value = "../net.onnx.data" if entry.key == "location" else entry.value
    path.write_bytes(model.SerializeToString())
    with pytest.raises(WeightsError, match="save the network as one file"):
        open_depth(path)


def test_a_network_for_any_camera_is_not_rescaled(tmp_path, image):
    network = open_depth(describe(green_network(tmp_path / "net.onnx"), f'gives = "metres"\nsigma_log = 0.1\n{SIZE}'))
    found = network(image, CAMERA)
    np.testing.assert_allclose(found.depth_m[:, :80], NEAR_M, rtol=1e-5)
    np.testing.assert_allclose(found.sigma_log, 0.1)


def test_sigma_is_the_networks_own_where_it_states_one(tmp_path, image):
    nodes = [node("Mul", "depth tenth", "sigma")]
    path = green_network(tmp_path / "net.onnx", nodes, "depth sigma", constants={"tenth": 0.1})
    found = open_depth(describe(path, f'gives = "metres"\nsigma = "sigma"\n{SIZE}'))(image, CAMERA)
    np.testing.assert_allclose(found.sigma_log, 0.1 * found.depth_m, rtol=1e-5)


def always(number):
    """A network that gives one number, whatever it sees."""
    nodes = [node("Mul", "depth none", "zero"), node("Add", "zero number", "out")]
    return {"nodes": nodes, "output": "out", "constants": {"none": 0.0, "number": number}}


ROWS = {"nodes": [node("Reshape", "depth rows", "out")], "output": "out"}


@pytest.mark.parametrize(
    ("network", "text", "words"),
    [
        ({"size": (64, 96)}, SIZE, "images of 64x96"),
        ({"size": (4096, 4096)}, "", "input_height must be from"),
        ({"channels": 4}, SIZE, r"expected \[1, 3, H, W\]"),
        ({**ROWS, "constants": {"rows": np.array([1, 1, 126, -1])}}, SIZE, "cannot be run on 112x112 pixels"),
        (always(np.nan), SIZE, "gives no depth"),
        (always(-9.0), SIZE, "gives no depth"),
        (always(2.0), SIZE, "the same depth for different images"),
    ],
)
def test_network_that_cannot_give_depth_is_one_line(tmp_path, network, text, words):
    path = describe(green_network(tmp_path / "net.onnx", **network), f'gives = "metres"\n{text}')
    with pytest.raises(WeightsError, match=words):
        open_depth(path)


def test_non_finite_pixels_are_unknown(tmp_path, image):
    """The logarithm of what is black after a shift is no number: those pixels alone have no depth."""
    nodes = [node("Sub", "depth near2", "less"), node("Log", "less", "log"), node("Exp", "log", "again")]
    path = green_network(tmp_path / "net.onnx", nodes, "again", constants={"near2": 2.0})
    depth = CheckedDepth(ExternalDepth(describe(path, f'gives = "metres"\n{SIZE}')))
    found = depth(image, CAMERA)
    assert np.isnan(found.depth_m[:, :90]).all()
    np.testing.assert_allclose(found.depth_m[:, 112:], FAR_M - 2.0, rtol=1e-4)


def test_constant_output_gives_no_relative_depth():
    for value in (3.0, np.nan, 0.0):
        assert np.isnan(relative_depth(np.full((4, 4), value, np.float32))).all()


def test_a_preset_can_be_corrected(tmp_path, image):
    path = describe(green_network(tmp_path / "n.onnx"), 'preset = "metric3d-v2-small"\ndepth = ""\nmultiple = 14\n')
    assert open_depth(path).network.multiple == 14


def test_input_of_any_size_gets_a_default_with_a_remark(tmp_path, caplog):
    network = open_depth(describe(green_network(tmp_path / "net.onnx"), 'gives = "metres"\nmultiple = 14\n'))
    assert network.network.input_height == network.network.input_width == 518
    assert "say input_height and input_width" in caplog.text


@pytest.mark.parametrize(
    "record",
    ['{"gives": ["metres"]}', '{"gives": "metres", "preset": []}', '{"gives": "metres", "mean": [[1], 2, 3]}', "[[[["],
)
def test_record_of_odd_types_is_one_line(tmp_path, record):
    model = onnx.load(green_network(tmp_path / "net.onnx"))
    model.metadata_props.add(key="edgeslam.depth", value=record)
    onnx.save(model, tmp_path / "net.onnx")
    with pytest.raises(WeightsError):
        open_depth(tmp_path / "net.onnx")
