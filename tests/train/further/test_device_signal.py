"""Pools on the device: their parts of a batch, and what arrives while they are learnt from."""

from pathlib import Path

import numpy as np
import pytest
import torch

from edgeslam_torch.errors import SourceError
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.further import device_signal
from edgeslam_torch.train.further.device_signal import Arriving, Pool, SupervisedOnDevice
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
    """A wall at 2 m fills the view alike at any zoom; nearer by as much as the focal length is longer."""
    given = signal(pool("wall", 2.0, 1.0))
    batch = given.draw(slots())
    mean, std = (torch.tensor(v).view(3, 1, 1) for v in (METADATA.mean, METADATA.std))
    assert ((batch["image"] * std + mean) >= 0).all()
    zooms = AugmentConfig().zoom
    # The pool's 320 px become 64: a focal length of 64 px at a zoom of 1, seen as if it were 60.
    told = torch.where(batch["mask"], batch["log_depth"], torch.nan).flatten(1).nanmedian(1).values.exp()
    least, most = (2.0 * 60 / (64 * zoom) for zoom in (zooms[1], zooms[0]))
    stretch = 0.1  # 60 x 80 pictures become 240 x 320, and these 32 x 64: not squares any more
    assert (told > least * (1 - stretch) * 0.9).all() and (told < most * (1 + stretch) * 1.5).all()
    assert told.max() / told.min() > 1.3


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
