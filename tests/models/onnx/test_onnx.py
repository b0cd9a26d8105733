"""ONNX: the exporter's file and the graph the SLAM builds for itself compute what torch computes."""

import numpy as np
import onnx
import onnxruntime
import pytest
import torch

from edgeslam_torch.models.checkpoint import build_network, save_checkpoint
from edgeslam_torch.models.fastdepth import Variant
from edgeslam_torch.models.onnx.export import ExportOptions, export_onnx
from edgeslam_torch.models.onnx.file import read_onnx
from edgeslam_torch.models.onnx.fold import deployed, fold_batch_norm
from edgeslam_torch.models.onnx.graph import build_graph
from edgeslam_torch.models.onnx.quantize import double_by_gather
from edgeslam_torch.models.record import Metadata


def random_network(metadata):
    """Fresh weights with batch norms that do something."""
    torch.manual_seed(1)
    network = build_network(metadata).eval()
    for module in network.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.running_mean, -0.5, 0.5)
            torch.nn.init.uniform_(module.running_var, 0.5, 2.0)
    return network


METADATA = Metadata(variant=Variant.PRUNED.value, sigma_scale=1.5, sigma_floor=0.05)


def agrees(model, network, metadata, x):
    with torch.no_grad():
        expected = deployed(network, metadata)(x)
    session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
    for ours, theirs in zip(session.run(["log_depth", "sigma_log"], {"image": x.numpy()}), expected, strict=True):
        np.testing.assert_allclose(ours, theirs.numpy(), rtol=1e-4, atol=1e-4)


def test_folding_batch_norm_changes_nothing():
    network = random_network(METADATA)
    x = torch.randn(1, 3, 32, 32)
    torch.testing.assert_close(fold_batch_norm(network).predict(x), network.predict(x), rtol=1e-4, atol=1e-4)
    assert any(isinstance(m, torch.nn.BatchNorm2d) for m in network.modules()), "the original is untouched"


@pytest.mark.parametrize(
    "metadata",
    [
        METADATA,
        Metadata(variant=Variant.PRUNED.value, padding="symmetric", output="depth", uncertainty=False, sigma_floor=0.2),
        Metadata(variant=Variant.NNCONV5DW.value),
    ],
)
def test_own_graph_equals_torch(tmp_path, metadata):
    network = random_network(metadata)
    save_checkpoint(network, metadata, tmp_path / "w.safetensors")
    graph, record = build_graph(tmp_path / "w.safetensors")
    assert record == metadata
    for size in ((64, 96), (32, 32)):
        agrees(graph, network, metadata, torch.randn(1, 3, *size))
    onnx.checker.check_model(onnx.load_from_string(graph), full_check=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "sizes"),
    [
        ({"opset": 17}, [(64, 96)]),
        ({"dynamic_size": True, "dynamic_batch": True}, [(64, 96), (96, 32)]),
    ],
)
def test_exported_file_holds_the_record_and_agrees_with_torch(tmp_path, options, sizes):
    network = random_network(METADATA)
    path = tmp_path / "model.onnx"
    export_onnx(network, METADATA, path, ExportOptions(64, 96, **options))
    model = onnx.load(str(path))
    if "opset" in options:  # for old runtimes
        assert [o.version for o in model.opset_import if o.domain == ""] == [17] and model.ir_version <= 9
    assert read_onnx(path)[1] == METADATA
    for batch, size in enumerate(sizes, 1):
        agrees(str(path), network, METADATA, torch.randn(batch, 3, *size))


def doubling(size):
    """Nearest-neighbour doubling between two additions, as torch exports it."""
    scales = onnx.numpy_helper.from_array(np.array([1, 1, 2, 2], np.float32), "scales")
    one = onnx.numpy_helper.from_array(np.float32(1), "one")
    how = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    nodes = [
        onnx.helper.make_node("Add", ["x", "one"], ["a"]),
        onnx.helper.make_node("Resize", ["a", "", "scales"], ["b"], **how),
        onnx.helper.make_node("Add", ["b", "one"], ["y"]),
    ]
    ends = [onnx.helper.make_tensor_value_info(n, onnx.TensorProto.FLOAT, s) for n, s in (("x", size), ("y", None))]
    graph = onnx.helper.make_graph(nodes, "doubling", ends[:1], ends[1:], [scales, one])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9)
    return onnx.shape_inference.infer_shapes(model)


def test_doubling_by_gather_copies_the_same_values():
    model = doubling([1, 3, 4, 6])
    x = np.random.default_rng(0).normal(size=(1, 3, 4, 6)).astype(np.float32)
    double_by_gather(model)
    onnx.checker.check_model(model, full_check=True)
    assert "Resize" not in {node.op_type for node in model.graph.node}
    assert "scales" not in {tensor.name for tensor in model.graph.initializer}
    (y,) = onnxruntime.InferenceSession(model.SerializeToString()).run(["y"], {"x": x})
    np.testing.assert_array_equal(y, np.repeat(np.repeat(x + 1, 2, 2), 2, 3) + 1)


def test_doubling_of_unknown_size_stays():
    model = doubling([1, 3, "height", "width"])
    double_by_gather(model)
    assert [node.op_type for node in model.graph.node] == ["Add", "Resize", "Add"]
