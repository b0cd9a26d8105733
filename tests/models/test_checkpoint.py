"""Weights on disk."""

import os
from collections import OrderedDict

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


def test_half_precision_halves_the_file_and_hardly_changes_depth(tmp_path):
    network, metadata = small_network()
    for name, half in (("full", False), ("half", True)):
        save_checkpoint(network, metadata, tmp_path / name, half)
    assert (tmp_path / "half").stat().st_size < 0.52 * (tmp_path / "full").stat().st_size
    x = torch.randn(1, 3, 64, 64)
    a, b = network.predict(x).log_depth, load_checkpoint(tmp_path / "half")[0].predict(x).log_depth
    assert (a - b).abs().max() < 1e-2 * (1 + a.abs().max())


def test_weights_of_ours_are_not_fed_as_others_when_their_record_is_missing(tmp_path):
    network, _ = small_network()
    torch.save(
        {"state_dict": network.state_dict(), "args": {"out": tmp_path, "device": torch.device("cpu")}},
        tmp_path / "w.pt",
    )
    with pytest.raises(WeightsError, match="record"):
        load_checkpoint(tmp_path / "w.pt")


def test_a_checkpoint_with_the_network_under_another_name_says_what_it_holds(tmp_path):
    torch.save({"student": small_network()[0].state_dict(), "epoch": 3}, tmp_path / "w.pt")
    with pytest.raises(WeightsError, match="student, epoch"):
        load_checkpoint(tmp_path / "w.pt")


def test_pickled_module_is_refused_with_the_remedy(tmp_path):
    parts = torch.nn.Sequential(OrderedDict(FastDepth(Variant.PRUNED).named_children()))
    torch.save({"model": parts}, tmp_path / "whole.pth.tar")
    with pytest.raises(WeightsError, match="edgeslam weights convert"):
        load_checkpoint(tmp_path / "whole.pth.tar")
