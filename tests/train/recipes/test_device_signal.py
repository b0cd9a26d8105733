"""Pools on the device: their parts of a batch, and what arrives while they are learnt from."""

from pathlib import Path

import numpy as np
import pytest
import torch

from edgeslam_torch.errors import SourceError
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.recipes import device_signal
from edgeslam_torch.train.recipes.device_signal import Arriving, Pool, SupervisedOnDevice
from edgeslam_torch.train.signals import Slot, SupervisedWeights
from edgeslam_torch.train.views.augment import AugmentConfig, View
from edgeslam_torch.train.views.batches import on_device

METADATA = Metadata(input_height=32, input_width=64, focal_px=60.0)
K = np.array([[80.0, 0, 39.5], [0, 80.0, 29.5], [0, 0, 1]])


def wall(depth_m: float) -> View:
    return View(np.full((60, 80, 3), 128, np.uint8), np.full((60, 80), depth_m, np.float32), K)


def pool(name: str, depth_m: float, share: float, **more) -> Pool:
    return Pool(name, on_device([wall(depth_m)], device_signal.POOL_SIZE, torch.device("cpu")), share, **more)


def write(path: Path, views: list[View]) -> None:
    np.savez(
        path,
        image=np.array([v.image for v in views]),
        depth=np.array([v.depth_m for v in views]),
        K=np.array([v.K for v in views]),
    )


def slots(step: int = 1, count: int = 40) -> list[Slot]:
    return [Slot(3, step, i) for i in range(count)]


def signal(*pools: Pool) -> SupervisedOnDevice:
    level = AugmentConfig(tilt_rad=0.0, roll_rad=0.0)
    return SupervisedOnDevice(pools, METADATA, level, SupervisedWeights())


def test_each_pool_has_its_share_and_its_weight() -> None:
    batch = signal(pool("near", 1.0, 3.0), pool("far", 8.0, 1.0, metric=0.2)).draw(slots(count=400))
    assert batch["image"].shape == (400, 3, 32, 64)
    near = batch["metric"] == 1.0
    assert int(near.sum()) == pytest.approx(300, abs=40)
    torch.testing.assert_close(batch["metric"][~near], torch.full((int((~near).sum()),), 0.2))
    depth = torch.where(batch["mask"], batch["log_depth"], torch.nan).flatten(1).nanmedian(1).values
    assert depth[near].max() < depth[~near].min()


def test_depth_is_that_of_the_focal_length_learnt_at() -> None:
    """A wall at 2 m, seen with a longer focal length than that of training, is told as nearer by as much."""
    K = np.array([[300.0, 0, 159.5], [0, 300.0, 119.5], [0, 0, 1]])
    wall = View(np.full((240, 320, 3), 128, np.uint8), np.full((240, 320), 2.0, np.float32), K)
    given = signal(Pool("wall", on_device([wall], device_signal.POOL_SIZE, torch.device("cpu")), 1.0))
    batch = given.draw(slots(count=200))
    told = torch.where(batch["mask"], batch["log_depth"], torch.nan).flatten(1).nanmedian(1).values.exp()
    fitted_px = 300.0 * np.sqrt(64 / 320 * 32 / 240)
    nearest, farthest = (2.0 * METADATA.focal_px / (fitted_px * zoom) for zoom in AugmentConfig().zoom[::-1])
    assert nearest * 0.99 < told.min() < nearest * 1.1
    assert farthest * 0.9 < told.max() < farthest * 1.01


def test_a_batch_is_a_function_of_seed_and_step() -> None:
    one, other = (signal(pool("near", 1.0, 1.0), pool("far", 8.0, 1.0)) for _ in range(2))
    torch.testing.assert_close(one.draw(slots(7)), other.draw(slots(7)))
    assert not torch.equal(one.draw(slots(8))["image"], other.draw(slots(7))["image"])
    assert len(one.describe(slots(7))) == 40


def test_views_that_arrive_are_learnt_from(tmp_path: Path) -> None:
    arriving = Arriving(tmp_path)
    growing = pool("places", 1.0, 1.0, more=arriving)
    given = signal(growing)
    given.draw(slots(0))
    assert len(growing.views) == 1
    write(tmp_path / "places_00000.npz", [wall(4.0)] * 3)
    write(tmp_path / "places_00010.npz", [wall(5.0)] * 2)
    given.draw(slots(1))
    assert len(growing.views) == 1, "asked for at every tenth step"
    given.draw(slots(10))
    assert len(growing.views) == 4, "one file at a time"
    given.draw(slots(20))
    given.draw(slots(30))
    assert len(growing.views) == 6, "each file once"


def test_a_folder_into_which_nothing_comes_is_said(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match=r"no places_\*.npz came in 0 s"):
        Arriving(tmp_path).wait(0.0)
