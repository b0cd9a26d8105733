"""Weights files that are damaged, hostile or of another network: one line, at once, whichever way they are loaded."""

import json
import struct
from dataclasses import asdict

import numpy as np
import pytest
import torch

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgeslam_torch.models.fastdepth import FULL, PRUNED, FastDepth, Variant, Widths
from edgeslam_torch.models.layout import parameter_shapes
from edgeslam_torch.models.onnx.graph import build_graph
from edgeslam_torch.models.record import Metadata, metadata_from_json
from edgeslam_torch.models.weights_file import read_header, read_weights

METADATA = Metadata(input_height=64, input_width=96, focal_px=80.0)
SMALL = Widths((8, 8) + (16,) * 12, (16, 16, 16, 8, 8))
LOADERS = [load_checkpoint, build_graph, read_weights]
"""Torch, onnxruntime, and what both stand on."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    save_checkpoint(build_network(METADATA, SMALL), METADATA, path)
    return path.read_bytes()


class File:
    """A safetensors file taken apart: change ``header`` or ``data`` and write it again."""

    def __init__(self, content):
        (length,) = struct.unpack("<Q", content[:8])
        self.header = json.loads(content[8 : 8 + length])
        self.data = bytearray(content[8 + length :])

    def array(self, name):
        """View of a float32 tensor's numbers."""
        start, stop = self.header[name]["data_offsets"]
        return np.frombuffer(self.data, "<f4")[start // 4 : stop // 4]

    def replace(self, name, kind, shape, content):
        """Another tensor under a name, its bytes at the end."""
        start = len(self.data)
        self.data += content
        self.header[name] = {"dtype": kind, "shape": shape, "data_offsets": [start, len(self.data)]}

    def record(self, **changes):
        self.header["__metadata__"]["edgeslam"] = json.dumps(asdict(METADATA) | changes)

    def write(self, path):
        header = json.dumps(self.header).encode()
        path.write_bytes(struct.pack("<Q", len(header)) + header + self.data)
        return path


@pytest.fixture
def file(whole):
    return File(whole)


def refused(path):
    for load in LOADERS:
        with pytest.raises(WeightsError) as caught:
            load(path)
        said = str(caught.value)
        assert str(path) in said and "\n" not in said and len(said) < 400


# -- names and shapes --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("variant", list(Variant))
@pytest.mark.parametrize("uncertainty", [True, False])
def test_layout_is_that_of_the_network(variant, uncertainty):
    widths = PRUNED if variant is Variant.PRUNED else FULL
    with torch.device("meta"):
        network = FastDepth(variant, uncertainty=uncertainty)
    shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    assert parameter_shapes(variant, widths, uncertainty) == shapes


def test_a_whole_file_comes_back(file, tmp_path):
    path = file.write(tmp_path / "w.safetensors")
    arrays, metadata = read_weights(path)
    assert metadata == METADATA == read_header(path)
    network, _ = load_checkpoint(path)
    for name, tensor in network.state_dict().items():
        np.testing.assert_array_equal(tensor.numpy(), arrays[name])


@pytest.mark.parametrize("kind", ["F16", "F64", "BF16"])
def test_other_precisions_are_read_as_they_are_written(file, tmp_path, kind):
    expected = torch.randn(8, 3, 3, 3)
    stored = expected.to({"F16": torch.float16, "F64": torch.float64, "BF16": torch.bfloat16}[kind])
    file.replace("conv0.0.weight", kind, [8, 3, 3, 3], stored.contiguous().view(torch.uint8).numpy().tobytes())
    arrays, _ = read_weights(file.write(tmp_path / "w.safetensors"))
    np.testing.assert_array_equal(arrays["conv0.0.weight"], stored.float().numpy())


@pytest.mark.parametrize(
    "change",
    [
        lambda f: f.header.pop("conv3.3.weight"),
        lambda f: f.header.pop("conv3.1.running_var"),
        lambda f: f.replace("extra", "F32", [1], bytes(4)),
        lambda f: f.replace("conv3.0.weight", "F32", [16, 1, 1, 9], bytes(576)),
        lambda f: f.replace("conv3.3.weight", "F32", [], bytes(4)),
        lambda f: f.replace("conv3.3.weight", "F32", [0, 16, 1, 1], b""),
        lambda f: f.replace("conv3.3.weight", "F32", [9999, 1, 1, 1], bytes(39996)),
        lambda f: f.replace("conv3.3.weight", "F32", [4000, 1, 1, 1], bytes(16000)),
        lambda f: f.replace("conv3.0.weight", "I64", [16, 1, 3, 3], bytes(1152)),
        lambda f: f.replace("conv3.0.weight", "F8_E4M3", [16, 1, 3, 3], bytes(144)),
        lambda f: f.replace("conv0.1.num_batches_tracked", "F32", [], bytes(4)),
        lambda f: f.header.update({"conv2.3.weight": f.header["conv3.3.weight"]}),
        lambda f: f.record(variant="mobilenet-nnconv5"),
        lambda f: f.array("conv0.0.weight").__setitem__(-1, np.nan),
        lambda f: f.array("conv7.1.running_mean").__setitem__(0, np.inf),
        lambda f: f.array("conv3.0.weight").__imul__(np.float32(-1e9)),
        lambda f: f.array("conv3.1.running_var").__setitem__(0, -1.0),
    ],
)
def test_another_network_is_refused(file, tmp_path, change):
    change(file)
    refused(file.write(tmp_path / "w.safetensors"))


def test_widths_that_cannot_be_added_are_refused(tmp_path):
    widths = Widths((8, 8) + (16,) * 12, (16, 16, 16, 4, 8))
    torch.manual_seed(0)
    save_checkpoint(build_network(METADATA, widths), METADATA, tmp_path / "w.safetensors")
    refused(tmp_path / "w.safetensors")


# -- the record --------------------------------------------------------------------------------------------------

WRONG = [None, [], {}, "text", "", -32, 1e5, float("nan"), float("inf"), True, 10**400, [[[]]], {"a": []}]
FIELDS = {
    "variant": [0, "resnet"],
    "input_height": [0, 33, 64.0, 4096],
    "input_width": [0, 33, 64.0, 4096],
    "focal_px": [0, 1e-3, 1e4],
    "mean": [0, [0.5, 0.5], [0.5, 0.5, float("nan")], ["a", "b", "c"], [0.5, 0.5, 1e9], [None] * 3],
    "std": [0, [0, 0, 0], [0.5, 0.5, 0], [0.5, 0.5, -0.5], [0.5, 0.5, 1e-30], [0.5] * 4, [True] * 3],
    "padding": [0, "valid"],
    "output": [0, "disparity"],
    "sigma_scale": [0, 1e-9],
    "units": [0, "mm"],
    "uncertainty": [0, 1],
    "data": [[1]],
    "metrics": [{"a": "b"}],
}


@pytest.mark.parametrize("field", FIELDS)
def test_a_record_with_a_wrong_field_is_refused(field):
    for value in WRONG + FIELDS[field]:
        if (field, value) in (("uncertainty", True), ("data", []), ("metrics", {})):
            continue  # right ones
        text = json.dumps(asdict(METADATA) | {field: value})
        with pytest.raises(WeightsError, match=f"metadata cannot be used: {field} must be") as caught:
            metadata_from_json(text)
        assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    "text", ["", "null", "[]", "3", "{}", "[" * 100_000, '{"variant": ' + "[" * 500 + "]" * 500 + "}",
             '{"input_width": ' + "9" * 5000 + "}"],
)  # fmt: skip
def test_what_is_no_record_is_refused(file, tmp_path, text):
    file.header["__metadata__"]["edgeslam"] = text
    path = file.write(tmp_path / "w.safetensors")
    refused(path)
    with pytest.raises(WeightsError):
        read_header(path)


def test_an_impossible_record_cannot_be_written():
    with pytest.raises(ValueError, match="focal_px must be"):
        Metadata(focal_px=float("nan"))
    with pytest.raises(ValueError, match="sigma_floor must be positive"):
        Metadata(uncertainty=False)


# -- the container -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("header", [b"[]", b'{"conv0.0.weight": 3}', b'{"__metadata__": {"edgeslam": [1]}}'])
def test_a_header_that_makes_no_sense_is_refused(tmp_path, header):
    path = tmp_path / "w.safetensors"
    path.write_bytes(struct.pack("<Q", len(header)) + header + bytes(8))
    refused(path)


def test_fields_of_newer_files_are_ignored():
    assert metadata_from_json(json.dumps(asdict(METADATA) | {"lens": "fisheye"})) == METADATA
