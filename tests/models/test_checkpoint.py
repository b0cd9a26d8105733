"""Weights on disk."""

import os

import pytest
import torch

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgeslam_torch.models.fastdepth import FastDepth, Variant
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.weights_file import read_header


def small_network():
    metadata = Metadata(variant=Variant.PRUNED.value, data=("a", "b"), metrics={"x": 0.5})
    torch.manual_seed(0)
    return build_network(metadata).eval(), metadata


def test_weights_and_record_come_back(tmp_path):
    network, metadata = small_network()
    save_checkpoint(network, metadata, tmp_path / "w.safetensors")
    loaded, record = load_checkpoint(tmp_path / "w.safetensors")
    assert record == metadata == read_header(tmp_path / "w.safetensors")
    x = torch.randn(1, 3, 32, 64)
    assert torch.equal(loaded(x), network(x))
    assert list(tmp_path.iterdir()) == [tmp_path / "w.safetensors"]


@pytest.mark.parametrize(
    ("prefix", "key"),
    [("module.", None), ("_orig_mod.", "model"), ("model._orig_mod.module.", "state_dict"), ("", "model_state_dict")],
)
def test_wrappers_around_a_network_are_taken_off_and_no_origin_is_made_up(tmp_path, prefix, key, caplog):
    network = FastDepth(Variant.PRUNED)
    state = {prefix + name: value for name, value in network.state_dict().items()}
    torch.save(state if key is None else {key: state, "epoch": 3}, tmp_path / "w.pt")
    loaded, metadata = load_checkpoint(tmp_path / "w.pt")
    assert torch.equal(loaded.state_dict()["conv3.3.weight"], network.state_dict()["conv3.3.weight"])
    assert (metadata.licence, metadata.data) == ("", ())
    assert "no record" in caplog.text


@pytest.mark.parametrize("name", ["w.safetensors", "w.pt"])
def test_a_pipe_is_no_weights_file(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with pytest.raises(WeightsError, match="not a file"):
        load_checkpoint(tmp_path / name)
