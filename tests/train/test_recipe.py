"""The recipe: exact resume, one-batch overfit, named failures, several processes."""

import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from edgeslam_torch.models.checkpoint import build_network, load_checkpoint
from edgeslam_torch.models.fastdepth import FastDepth, Widths
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.augment import AugmentConfig, View
from edgeslam_torch.train.recipe import Hooks, NonFiniteLossError, TrainConfig, TrainState, learning_rate_factor, train
from edgeslam_torch.train.signals import Slot, Source, Supervised, SupervisedWeights

METADATA = Metadata(input_height=32, input_width=64, focal_px=50.0)
TINY = Widths((4,) + (8,) * 13, (8,) * 5)
CONFIG = TrainConfig(steps=6, batch=4, warmup_steps=2, validate_every=3, checkpoint_every=2, frozen_stages=1)
STILL = AugmentConfig(0, (1, 1), 0, 0, 0, 0, 0, 0, 0, 0, (1, 1), 0, 0, 0)


def views(count: int = 3) -> list[View]:
    rng = np.random.default_rng(0)
    K = np.array([[50.0, 0, 31.5], [0, 50.0, 15.5], [0, 0, 1]])
    depth = np.linspace(1, 4, 64, dtype=np.float32)[None].repeat(32, 0)
    return [View(rng.integers(0, 256, (32, 64, 3), np.uint8), depth + i, K) for i in range(count)]


def network(seed: int = 0) -> FastDepth:
    torch.manual_seed(seed)
    return build_network(METADATA, TINY)


def signal(augment: AugmentConfig | None = None) -> Supervised:
    return Supervised([Source("made", views(), 1.0)], METADATA, augment or AugmentConfig())


def run(out: Path, config: TrainConfig = CONFIG, hooks: Sequence[Hooks] = ()) -> TrainState:
    return train(network(), METADATA, [signal()], config, out, lambda n: {"score": 1.0}, hooks)


class _Killed(RuntimeError):
    """Stands for the signal that ends a process."""


class _KillAt(Hooks):
    def __init__(self, step: int) -> None:
        self.step = step

    def on_step(self, state: TrainState, losses: dict[str, float]) -> None:
        if state.step == self.step:
            raise _Killed


@pytest.mark.parametrize("step", [1, 2, 3, 5, 6])
def test_killed_and_resumed_run_ends_with_the_same_weights(tmp_path: Path, step: int) -> None:
    whole = run(tmp_path / "whole")
    with pytest.raises(_Killed):
        run(tmp_path / "killed", hooks=[_KillAt(step)])
    resumed = run(tmp_path / "killed")
    assert resumed.step == whole.step == 6
    for mine, other in ((whole.network, resumed.network), (whole.averaged, resumed.averaged)):
        for (name, a), b in zip(mine.state_dict().items(), other.state_dict().values(), strict=True):
            assert torch.equal(a, b), name
    assert whole.history == resumed.history


def test_finished_run_is_not_trained_further(tmp_path: Path) -> None:
    run(tmp_path)
    before = (tmp_path / "final.safetensors").read_bytes()
    assert run(tmp_path).step == 6
    assert (tmp_path / "final.safetensors").read_bytes() == before
    assert load_checkpoint(tmp_path / "final.safetensors")[1] == METADATA


def test_one_batch_is_learnt_almost_to_zero(tmp_path: Path) -> None:
    losses: list[float] = []

    class Record(Hooks):
        def on_step(self, state: TrainState, named: dict[str, float]) -> None:
            losses.append(named["supervised/l1"])

    weights = SupervisedWeights(uncertainty=0.0, gradient=0.1)
    one = Supervised([Source("one", views(1), 1.0)], METADATA, STILL, weights)
    wide = Widths((8,) + (16,) * 13, (16,) * 5)
    torch.manual_seed(0)
    config = TrainConfig(steps=250, batch=1, lr=2e-2, encoder_lr=5e-3, frozen_stages=0, warmup_steps=10, weight_decay=0)
    train(build_network(METADATA, wide), METADATA, [one], config, tmp_path, hooks=[Record()])
    assert losses[0] > 0.5
    assert np.mean(losses[-20:]) < 0.03


def test_not_finite_loss_stops_and_names_the_images(tmp_path: Path) -> None:
    class Poisoned(Supervised):
        def losses(self, network: FastDepth, batch: dict[str, Tensor]) -> dict[str, Tensor]:
            found = super().losses(network, batch)
            found["l1"] = found["l1"].clone()
            found["l1"][2] = torch.nan
            return found

    poisoned = Poisoned([Source("made", views(), 1.0)], METADATA)
    named = poisoned.describe([Slot(0, 0, 2)])[0]
    with pytest.raises(NonFiniteLossError, match=f"step 0: loss supervised/l1 is not finite for {named};"):
        train(network(), METADATA, [poisoned], CONFIG, tmp_path)


def test_early_stopping_counts_validations_without_progress(tmp_path: Path) -> None:
    scores = iter([1.0, 0.5, 0.6, 0.7, 0.4])
    ended: list[str] = []

    class Record(Hooks):
        def on_end(self, state: TrainState, reason: str) -> None:
            ended.append(reason)

    config = replace(CONFIG, steps=50, validate_every=1, patience=2)
    state = train(network(), METADATA, [signal()], config, tmp_path, lambda n: {"score": next(scores)}, [Record()])
    assert state.step == 4
    assert state.best == 0.5
    assert ended == ["no improvement in 2 validations"]


def test_frozen_parts_do_not_move_and_their_statistics_neither(tmp_path: Path) -> None:
    before = network().state_dict()
    config = replace(CONFIG, frozen_stages=14, freeze_norm=True)
    after = train(network(), METADATA, [signal()], config, tmp_path).network.state_dict()
    for name, value in before.items():
        moved = not torch.equal(value, after[name])
        if name.startswith("conv") or "running" in name:
            assert not moved, name
    assert not torch.equal(before["decode_conv3.1.0.weight"], after["decode_conv3.1.0.weight"])


def test_learning_rate_rises_then_falls() -> None:
    factors = [learning_rate_factor(i, TrainConfig(steps=100, warmup_steps=10)) for i in range(100)]
    assert factors[0] == pytest.approx(0.1)
    assert max(factors) == factors[9] == pytest.approx(1.0)
    assert factors[-1] == pytest.approx(0.01, abs=0.002)
    assert all(a >= b for a, b in zip(factors[9:], factors[10:], strict=False))


def test_mixed_precision_trains(tmp_path: Path) -> None:
    state = run(tmp_path, replace(CONFIG, steps=2, amp=True))
    assert all(torch.isfinite(p).all() for p in state.network.parameters())


SCRIPT = """
import sys, torch
from pathlib import Path
from edgeslam_torch.train.distributed import process_group
sys.path.insert(0, {folder!r})
from {module} import CONFIG, METADATA, network, replace, signal, train
torch.set_num_threads(1)
with process_group() as rank:
    config = replace(CONFIG, freeze_norm=True, batch=4)
    state = train(network(), METADATA, [signal()], config, Path(sys.argv[1]))
    if rank == 0:
        torch.save(state.network.state_dict(), sys.argv[2])
"""


def test_two_processes_give_the_single_process_result(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(folder=str(Path(__file__).parent), module=Path(__file__).stem))
    alone, together = tmp_path / "alone.pt", tmp_path / "together.pt"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(script)]
    subprocess.run([*command, str(tmp_path / "a"), str(alone)], check=True, env=environment, timeout=200)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    workers = []
    for rank in range(2):
        given = {"RANK": str(rank), "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
        workers.append(subprocess.Popen([*command, str(tmp_path / "b"), str(together)], env=environment | given))
    assert [w.wait(timeout=200) for w in workers] == [0, 0]
    first, second = torch.load(alone), torch.load(together)
    for name, value in first.items():
        # The same images and terms, added up in another order.
        torch.testing.assert_close(second[name], value, rtol=1e-3, atol=2e-5, msg=name)
