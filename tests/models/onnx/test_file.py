"""ONNX files that are damaged, hostile or not ours are refused before they run."""

import json
from dataclasses import asdict

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper
from small_depth import narrow_fastdepth

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.frontend.depth_network import DepthPredictor
from edgeslam_torch.models.checkpoint import save_checkpoint
from edgeslam_torch.models.onnx.file import parse_onnx, read_onnx
from edgeslam_torch.models.onnx.graph import build_graph
from edgeslam_torch.models.record import Metadata

METADATA = Metadata(input_height=64, input_width=96, focal_px=80.0)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    save_checkpoint(narrow_fastdepth(METADATA), METADATA, path)
    return build_graph(path)[0]


def with_record(model, text):
    helper.set_model_props(model, {"edgeslam": text})


def with_field(**fields):
    return lambda model: with_record(model, json.dumps(asdict(METADATA) | fields))


def with_constant(array):
    def change(model):
        model.graph.initializer[0].CopyFrom(numpy_helper.from_array(array, model.graph.initializer[0].name))

    return change


def with_input(*shape):
    def change(model):
        model.graph.input[0].CopyFrom(helper.make_tensor_value_info("image", TensorProto.FLOAT, shape))

    return change


def claims_more_than_it_holds(model):
    model.graph.initializer[0].dims[:] = [1 << 40]


def outside_the_file(model):
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="../../etc/passwd")


def test_a_whole_file_is_read(whole, tmp_path):
    (tmp_path / "w.onnx").write_bytes(whole)
    assert read_onnx(tmp_path / "w.onnx") == (whole, METADATA)
    assert DepthPredictor(tmp_path / "w.onnx").metadata == METADATA


def test_numbers_beside_the_file_are_read_and_missed_by_name(whole, tmp_path):
    model = onnx.load_model_from_string(whole)
    onnx.save(model, str(tmp_path / "w.onnx"), save_as_external_data=True, location="w.data", size_threshold=0)
    read = {t.name: numpy_helper.to_array(t) for t in parse_onnx(tmp_path / "w.onnx").model.graph.initializer}
    for tensor in onnx.load_model_from_string(whole).graph.initializer:
        np.testing.assert_array_equal(read[tensor.name], numpy_helper.to_array(tensor))
    (tmp_path / "w.data").unlink()
    with pytest.raises(WeightsError, match=r"w\.onnx: .*w\.data"):
        parse_onnx(tmp_path / "w.onnx")


def test_numbers_behind_a_link_are_read_as_caches_of_downloads_keep_them(whole, tmp_path):
    model = onnx.load_model_from_string(whole)
    onnx.save(model, str(tmp_path / "w.onnx"), save_as_external_data=True, location="w.data", size_threshold=0)
    (tmp_path / "w.data").rename(tmp_path / "0f3a")
    (tmp_path / "w.data").symlink_to("0f3a")
    read = parse_onnx(tmp_path / "w.onnx").model.graph.initializer
    for tensor, exact in zip(read, onnx.load_model_from_string(whole).graph.initializer, strict=True):
        np.testing.assert_array_equal(numpy_helper.to_array(tensor), numpy_helper.to_array(exact))
    (tmp_path / "0f3a").write_bytes((tmp_path / "0f3a").read_bytes()[:-1])
    with pytest.raises(WeightsError, match=r"w\.onnx: .*w\.data"):
        parse_onnx(tmp_path / "w.onnx")


@pytest.mark.parametrize(
    "change",
    [
        lambda m: m.ClearField("metadata_props"),
        lambda m: with_record(m, "null"),
        with_field(std=[0, 0, 0]),
        with_field(input_width=-32),
        with_constant(np.array([np.nan], np.float32)),
        with_constant(np.array([1e30], np.float32)),
        with_constant(np.array([np.inf], np.float16)),
        with_constant(np.zeros((3, 3, 3), np.float32)),
        claims_more_than_it_holds,
        outside_the_file,
        with_input(1, 3, 64, 100),
        with_input(1, 3, 1 << 40, 64),
        with_input(1, 3, -32, 64),
        with_input(1, 1, 64, 64),
        with_input(3, 64, 64),
        with_input(),
        lambda m: m.graph.input.add(name="secret"),
        lambda m: m.graph.output.pop(),
        lambda m: m.ClearField("graph"),
    ],
)
def test_what_cannot_be_meant_is_refused(whole, tmp_path, change):
    model = onnx.load_model_from_string(whole)
    change(model)
    path = tmp_path / "w.onnx"
    path.write_bytes(model.SerializeToString())
    with pytest.raises(WeightsError) as caught:
        DepthPredictor(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_random_damage_is_refused_or_harmless(whole, tmp_path, rng):
    path = tmp_path / "w.onnx"
    for k in range(40):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), rng.integers(1, 20)):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged if k % 2 else damaged[: rng.integers(len(damaged))])
        try:
            assert isinstance(read_onnx(path)[1], Metadata)
        except WeightsError as error:
            assert "\n" not in str(error)
