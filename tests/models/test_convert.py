"""Upstream's pickled checkpoints: read without running them."""

import argparse
import os
import sys
import types

import numpy as np
import pytest
import torch
from torch import nn

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import load_checkpoint
from edgeslam_torch.models.convert import convert_upstream, read_upstream
from edgeslam_torch.models.fastdepth import FastDepth, Variant


@pytest.fixture
def upstream_class():
    """A class that pickles as upstream's ``models.MobileNetSkipAdd`` does."""
    module = types.ModuleType("models")

    class MobileNetSkipAdd(nn.Module):
        def __init__(self, network):
            super().__init__()
            for name, child in network.named_children():
                self.add_module(name, child)

    MobileNetSkipAdd.__module__, MobileNetSkipAdd.__qualname__ = "models", "MobileNetSkipAdd"
    module.MobileNetSkipAdd = MobileNetSkipAdd
    before = sys.modules.get("models")
    sys.modules["models"] = module
    yield MobileNetSkipAdd
    del sys.modules["models"]
    if before is not None:
        sys.modules["models"] = before


@pytest.mark.filterwarnings("ignore:Couldn't retrieve source")
@pytest.mark.parametrize("zipped", [True, False])
def test_whole_module_becomes_tensors(tmp_path, upstream_class, zipped):
    network = FastDepth(Variant.PRUNED).eval()
    path = tmp_path / "model_best.pth.tar"
    content = {"model": upstream_class(network), "epoch": 19, "best_result": 0.6}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    metadata = convert_upstream(path, tmp_path / "out.safetensors")
    assert metadata.variant == Variant.PRUNED.value
    loaded, record = load_checkpoint(tmp_path / "out.safetensors")
    assert record.padding == "symmetric"
    x = torch.randn(1, 3, 32, 32)
    assert torch.equal(loaded(x), network(x))


class _Hostile:
    def __init__(self, marker):
        self.marker = marker

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


@pytest.mark.parametrize("zipped", [True, False])
def test_hostile_pickle_runs_nothing_beside_a_network_or_in_its_place(tmp_path, zipped):
    marker, network = _Hostile(tmp_path / "ran"), FastDepth(Variant.PRUNED).state_dict()
    torch.save({"model": network, "epoch": marker}, tmp_path / "evil.pth", _use_new_zipfile_serialization=zipped)
    np.testing.assert_array_equal(read_upstream(tmp_path / "evil.pth")[0]["conv3.3.weight"], network["conv3.3.weight"])
    torch.save({"model": marker}, tmp_path / "evil.pth", _use_new_zipfile_serialization=zipped)
    with pytest.raises(WeightsError, match="no network"):
        read_upstream(tmp_path / "evil.pth")
    assert not marker.marker.exists()


@pytest.mark.filterwarnings("ignore:Couldn't retrieve source")
def test_what_training_left_beside_the_network_is_passed_over(tmp_path, upstream_class):
    """As upstream's training script saves it: arguments, optimiser and all."""
    network = upstream_class(FastDepth(Variant.PRUNED).eval())
    optimiser = torch.optim.SGD(network.parameters(), 0.1, momentum=0.9)
    content = {"args": argparse.Namespace(arch="x"), "epoch": 3, "best_result": np.float64(0.6), "optimizer": optimiser}
    torch.save(content | {"model": network}, tmp_path / "w.pth.tar", _use_new_zipfile_serialization=False)
    assert convert_upstream(tmp_path / "w.pth.tar", tmp_path / "out.safetensors").variant == Variant.PRUNED.value


def test_damaged_files_are_named(tmp_path):
    torch.save(FastDepth(Variant.PRUNED).state_dict(), tmp_path / "w.pt", _use_new_zipfile_serialization=False)
    whole = (tmp_path / "w.pt").read_bytes()
    for cut in (0, 1, 20, 3000, len(whole) // 2, len(whole) - 3):
        (tmp_path / "cut.pt").write_bytes(whole[:cut])
        with pytest.raises(WeightsError, match=r"cut\.pt"):
            read_upstream(tmp_path / "cut.pt")
