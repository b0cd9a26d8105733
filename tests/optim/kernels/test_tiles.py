"""Places of blocks and pairs in their tiles: every value comes back, every pair meets its host and target."""

import numpy as np
import pytest
import torch

from edgeslam_torch.optim.kernels import tiles as tiles_module
from edgeslam_torch.optim.kernels.tiles import Tiles, lay_out

POSES = 7


@pytest.fixture(params=[2048, 16], ids=["a tile a host", "several tiles a host"])
def scene(request, rng, monkeypatch) -> tuple[Tiles, np.ndarray, np.ndarray, np.ndarray]:
    monkeypatch.setattr(tiles_module, "_MAX_LANES", request.param)
    host = rng.choice([0, 1, 1, 1, 4, 6], 90)  # unsorted, of very different number, some poses host nothing
    block, pose = np.divmod(rng.permutation(90 * POSES)[:250], POSES)
    seen = host[block] != pose
    return lay_out(host, block[seen], pose[seen], POSES), host, block[seen], pose[seen]


def test_values_come_back_from_their_places(scene, rng):
    tiles, host, block, _ = scene
    B, T, L = tiles.shape
    of_blocks, of_pairs = rng.normal(size=(3, len(host))), rng.normal(size=(2, len(block)))
    placed = tiles.blocks(of_blocks, torch.float64, 9.0)
    assert placed.shape == (3, B, L)
    assert int((placed == 9.0).sum()) == 3 * (B * L - len(host))
    np.testing.assert_array_equal(tiles.of_blocks(placed), of_blocks)
    placed = tiles.pairs(of_pairs, torch.float32)
    assert placed.shape == (2, B, T, L)
    assert placed.dtype is torch.float32
    np.testing.assert_allclose(tiles.of_pairs(placed), of_pairs, rtol=1e-6)


def test_every_pair_meets_its_block_its_host_and_its_target(scene):
    tiles, host, block, pose = scene
    B, T, L = tiles.shape
    number = tiles.blocks(np.arange(len(host)), torch.float64)[:, None].expand(B, T, L)
    np.testing.assert_array_equal(tiles.of_pairs(number), block)
    np.testing.assert_array_equal(tiles.of_pairs(tiles.host[:, None, None].expand(B, T, L)), host[block])
    np.testing.assert_array_equal(tiles.of_pairs(tiles.target[..., None].expand(B, T, L)), pose)


def test_a_pair_twice_and_a_host_as_its_own_target_are_refused():
    host = np.array([0, 1])
    with pytest.raises(ValueError, match="only once"):
        lay_out(host, np.array([0, 0]), np.array([1, 1]), 2)
    with pytest.raises(ValueError, match="differ from its host"):
        lay_out(host, np.array([0]), np.array([0]), 2)


def test_blocks_without_pairs_have_places_too():
    none = np.zeros(0, np.int64)
    tiles = lay_out(np.array([1, 1, 0]), none, none, 2)
    assert tiles.of_blocks(tiles.blocks(np.arange(3.0), torch.float64)).tolist() == [0.0, 1.0, 2.0]
