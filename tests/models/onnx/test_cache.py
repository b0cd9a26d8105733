"""The shipped networks' ONNX files in the cache."""

import shutil

import pytest

from edgeslam_torch.frontend.depth_network import DepthPredictor
from edgeslam_torch.models.onnx.cache import cached_graph
from edgeslam_torch.models.onnx.graph import build_graph
from edgeslam_torch.models.record import DEFAULT_WEIGHTS


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("EDGESLAM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_a_shipped_network_is_made_once(cache):
    file, metadata = cached_graph(DEFAULT_WEIGHTS)
    assert (file.read_bytes(), metadata) == build_graph(DEFAULT_WEIGHTS)
    made = file.stat()
    assert cached_graph(DEFAULT_WEIGHTS) == (file, metadata)
    assert (file.stat().st_mtime_ns, file.stat().st_ino) == (made.st_mtime_ns, made.st_ino)
    assert list(cache.iterdir()) == [file]


def test_weights_of_the_users_own_leave_nothing(cache, tmp_path):
    own = tmp_path / "tuned.safetensors"
    shutil.copy(DEFAULT_WEIGHTS, own)
    assert cached_graph(own) == build_graph(own)
    assert not cache.exists()


@pytest.mark.parametrize("content", [b"", b"not a network", None], ids=["empty", "other", "truncated"])
def test_a_damaged_cached_network_is_made_again(cache, content):
    file, _ = cached_graph(DEFAULT_WEIGHTS)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if content is None else content)
    DepthPredictor()
    assert file.read_bytes() == whole
