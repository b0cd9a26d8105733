"""The loop: exact resume, one-batch overfit, named failures, several processes."""

import errno
import os
import shutil
import signal as signal_number
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_depth import METADATA, SmallDepth
from small_depth import small_depth as network

from edgeslam_torch.errors import ConfigError, SourceError, WeightsError
from edgeslam_torch.models.checkpoint import build_network
from edgeslam_torch.models.fastdepth import Variant, Widths
from edgeslam_torch.models.weights_file import read_header
from edgeslam_torch.train import loop
from edgeslam_torch.train import state as state_file
from edgeslam_torch.train.hooks import Hooks
from edgeslam_torch.train.loop import DivergedError, NonFiniteLossError, learning_rate_factor, train
from edgeslam_torch.train.processes.device import Arithmetic
from edgeslam_torch.train.processes.loading import WorkerError
from edgeslam_torch.train.signals import Slot, Source, Supervised, SupervisedWeights
from edgeslam_torch.train.state import TrainConfig, saved_step
from edgeslam_torch.train.validate import image_tensor
from edgeslam_torch.train.views.augment import AugmentConfig, View

CONFIG = TrainConfig(steps=6, batch=4, warmup_steps=2, validate_every=3, checkpoint_every=2, frozen_stages=0)
STILL = AugmentConfig(0, (1, 1), 0, 0, 0, 0, 0, 0, 0, 0, (1, 1), 0, 0, 0)


def views(count=3):
    rng = np.random.default_rng(0)
    K = np.array([[50.0, 0, 31.5], [0, 50.0, 15.5], [0, 0, 1]])
    depth = np.linspace(1, 4, 64, dtype=np.float32)[None].repeat(32, 0)
    return [View(rng.integers(0, 256, (32, 64, 3), np.uint8), depth + i, K) for i in range(count)]


def signal(augment=None):
    return Supervised([Source("made", views(), 1.0)], METADATA, augment or AugmentConfig())


def run(out, config=CONFIG, hooks=()):
    return train(network(), METADATA, [signal()], config, out, lambda n: {"score": 1.0}, hooks)


class At(Hooks):
    """Does something after one step; keeps every step's losses and the reason of the end."""

    def __init__(self, step=0, do=None):
        self.step, self.do, self.losses, self.ended, self.closed = step, do, [], [], False

    def on_step(self, state, losses):
        self.losses.append(losses)
        if state.step == self.step:
            self.do(state)

    def on_end(self, state, reason):
        self.ended.append(reason)

    def close(self):
        self.closed = True


def raising(error):
    def do(state):
        raise error

    return do


def multiplied(factor):
    """What a learning rate far too large does."""

    def do(state):
        with torch.no_grad():
            for parameter in state.network.parameters():
                parameter.mul_(factor)

    return do


def assert_same(whole, other):
    assert other.step == whole.step
    for mine, theirs in ((whole.network, other.network), (whole.averaged, other.averaged)):
        for (name, a), b in zip(mine.state_dict().items(), theirs.state_dict().values(), strict=True):
            assert torch.equal(a, b), name
    assert whole.history == other.history
    assert (whole.best, whole.best_step) == (other.best, other.best_step)


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """Folders ``step1`` to ``step6`` as a SIGKILL after each step of one run leaves them."""
    folder = tmp_path_factory.mktemp("killed")
    run(folder / "whole", hooks=[At(i, lambda state: _copied(folder, state.step)) for i in range(1, 7)])
    return folder


def _copied(folder, step):
    shutil.copytree(folder / "whole", folder / f"step{step}")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The end of a run that nothing disturbed; not to be changed."""
    return run(tmp_path_factory.mktemp("whole"))


@pytest.mark.parametrize("step", [1, 3, 6])
def test_killed_and_resumed_run_ends_with_the_same_weights(whole, killed, step):
    assert_same(whole, run(killed / f"step{step}"))


@pytest.mark.parametrize("error", [KeyboardInterrupt(), RuntimeError("a broken hook")])
def test_interrupt_and_broken_hook_lose_no_step(whole, tmp_path, error):
    hook = At(5, raising(error))
    with pytest.raises(type(error)):
        run(tmp_path / "stopped", hooks=[hook])
    assert hook.closed
    assert saved_step(tmp_path / "stopped" / "last.pt") == 5
    assert_same(whole, run(tmp_path / "stopped"))


def test_interrupt_between_two_weights_of_a_step_saves_the_step_before(whole, tmp_path, monkeypatch):
    steps = []
    real = torch.optim.AdamW.step

    def interrupted(self, *args):
        steps.append(real(self, *args))
        if len(steps) == 4:
            raise KeyboardInterrupt
        return steps[-1]

    with monkeypatch.context() as patch:
        patch.setattr(torch.optim.AdamW, "step", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path / "stopped")
    assert saved_step(tmp_path / "stopped" / "last.pt") == 2, "the last checkpoint"
    assert_same(whole, run(tmp_path / "stopped"))


def test_full_disk_keeps_the_checkpoint_before(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        run(tmp_path, hooks=[At(3, lambda state: monkeypatch.setattr(state_file, "write_atomically", full))])
    assert saved_step(tmp_path / "last.pt") == 2
    monkeypatch.undo()
    assert run(tmp_path).step == 6


def test_more_steps_go_on_where_fewer_ended(tmp_path):
    run(tmp_path)
    state = run(tmp_path, replace(CONFIG, steps=9))
    assert state.step == 9
    assert [row["step"] for row in state.history] == [3, 6, 9]
    with pytest.raises(ConfigError, match="has 9 steps already"):
        run(tmp_path, replace(CONFIG, steps=8))


def test_learning_rate_after_a_resume_is_the_one_asked_for(tmp_path):
    run(tmp_path)
    slower = replace(CONFIG, steps=9, lr=1e-5, encoder_lr=2e-6, lr_end=1.0)
    state = run(tmp_path, slower)
    assert [group["lr"] for group in state.optimiser.param_groups] == [2e-6, 1e-5]


@pytest.mark.parametrize("content", [b"", b"no torch file", b"PK\x03\x04 cut off"])
def test_damaged_state_is_named(tmp_path, content):
    (tmp_path / "last.pt").write_bytes(content)
    with pytest.raises(WeightsError, match=r"last\.pt: damaged"):
        run(tmp_path)


class _PoisonedAt(Supervised):
    """Its loss of one image is NaN from a step on."""

    step, image = 0, 2

    def draw(self, slots):
        self.poisoned = slots[0].step >= self.step
        return super().draw(slots)

    def losses(self, predicted, batch):
        found = super().losses(predicted, batch)
        found["l1"] = found["l1"].clone()
        if self.poisoned:
            found["l1"][self.image] = torch.nan
        return found


@pytest.mark.parametrize(("step", "kept"), [(0, "nothing was saved"), (5, "last.pt holds step 4, the last good one")])
def test_not_finite_loss_stops_and_names_the_images(tmp_path, step, kept):
    poisoned = _PoisonedAt([Source("made", views(), 1.0)], METADATA)
    poisoned.step = step
    named = signal().draw([Slot(0, step, 2)])[1][0]
    expected = f"step {step}: loss supervised/l1 is not finite for {named}; .*{kept}"
    with pytest.raises(NonFiniteLossError, match=expected):
        train(network(), METADATA, [poisoned], CONFIG, tmp_path)
    assert saved_step(tmp_path / "last.pt") == (4 if step else 0)


@pytest.fixture(scope="module")
def longer(tmp_path_factory):
    """A run of eight steps and its end."""
    config = replace(CONFIG, steps=8)
    return config, run(tmp_path_factory.mktemp("longer"), config)


@pytest.mark.parametrize(("factor", "step"), [(1e3, 5), (1e30, 4), (torch.nan, 5)])
def test_last_state_is_a_working_network_after_a_divergence(longer, tmp_path, factor, step):
    config, whole = longer
    with pytest.raises(DivergedError, match=r"last\.pt holds step [24], the last good one"):
        run(tmp_path, config, hooks=[At(step, multiplied(factor))])
    assert saved_step(tmp_path / "last.pt") == (2 if step == 4 else 4)
    assert_same(whole, run(tmp_path, config))


def test_interrupt_after_an_explosion_saves_no_ruin(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, hooks=[At(3, multiplied(1e30)), At(3, raising(KeyboardInterrupt()))])
    assert saved_step(tmp_path / "last.pt") == 2


@pytest.mark.parametrize(
    "wrong", [{"lr": 0.0}, {"lr": float("nan")}, {"encoder_lr": 2.0}, {"batch": 0}, {"seed": -1}, {"accumulate": 5}]
)
def test_settings_that_cannot_train_are_refused(wrong):
    with pytest.raises(ValueError, match=f"^{next(iter(wrong))} must"):
        replace(CONFIG, **wrong)


def test_only_what_beats_the_weights_before_is_the_best(tmp_path):
    scores = iter([0.6, 0.7])
    state = train(
        network(), METADATA, [signal()], CONFIG, tmp_path, lambda n: {"score": next(scores)}, before={"score": 0.5}
    )
    assert (state.best, state.best_step, state.stale) == (0.5, 0, 2)
    assert not (tmp_path / "best.safetensors").exists()
    assert [row["step"] for row in state.history] == [0, 3, 6]


def test_early_stopping_counts_validations_without_progress_also_over_a_resume(tmp_path):
    scores = iter([1.0, 0.5, 0.6, 0.7, 0.4])
    config = replace(CONFIG, steps=50, validate_every=1, patience=2)
    for ended in (["no improvement in 2 validations"], []):
        record = At()
        state = train(network(), METADATA, [signal()], config, tmp_path, lambda n: {"score": next(scores)}, [record])
        assert (state.step, state.best, record.losses == []) == (4, 0.5, not ended)


def test_frozen_parts_do_not_move_and_their_statistics_neither(tmp_path):
    before = network().state_dict()
    config = replace(CONFIG, frozen_stages=1, freeze_norm=True)
    after = train(network(), METADATA, [signal()], config, tmp_path).network.state_dict()
    for name, value in before.items():
        moved = not torch.equal(value, after[name])
        if name.startswith("coder") or "running" in name:
            assert not moved, name
    assert not torch.equal(before["head.weight"], after["head.weight"])


ENVIRONMENT = os.environ | {
    "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]),
    "OMP_NUM_THREADS": "1",
}
BEGIN = f"""
import sys, torch
from pathlib import Path
from edgeslam_torch.train.processes.distributed import process_group, rank
from {Path(__file__).stem} import *
from {Path(__file__).stem} import _PoisonedAt
torch.set_num_threads(1)
"""
TWO_RECORDINGS = """
with process_group():
    config = shared_config(frozen=sys.argv[3] == "frozen")
    state = train(network(), METADATA, [two_recordings()], config, Path(sys.argv[1]))
    if rank() == 0:
        torch.save([state.network.state_dict(), state.averaged.state_dict()], sys.argv[2])
threads = [path.read_text() for path in Path("/proc/self/task").glob("*/comm")]
assert not [name for name in threads if "gloo" in name], "the group's threads would abort the process at its end"
"""
POISONED = """
with process_group():
    poisoned = _PoisonedAt([Source("made", views(), 1.0)], METADATA)
    poisoned.step, poisoned.image = 3 if rank() else 99, 0
    try:
        train(network(), METADATA, [poisoned], replace(CONFIG, freeze_norm=True), Path(sys.argv[1]))
    except NonFiniteLossError as error:
        sys.exit(str(error))
"""
STOPPED = """
class Stop(Hooks):
    def on_step(self, state, losses):
        if rank() == 1 and state.step == 2:
            state.stop = "asked for by the second"

    def on_end(self, state, reason):
        sys.stderr.write(f"{reason} at {state.step}")

with process_group():
    train(network(), METADATA, [signal()], replace(CONFIG, freeze_norm=True), Path(sys.argv[1]), hooks=[Stop()])
"""


def two_recordings():
    sources = [Source("first", views(3), 1.0), Source("second", views(5)[3:], 2.0)]
    return Supervised(sources, METADATA, AugmentConfig())


def shared_config(frozen):
    """Five images a step: three in one process, two in the other."""
    return replace(CONFIG, steps=20, batch=5, freeze_norm=frozen, checkpoint_every=20)


def in_two_processes(script, *words):
    """Exit code and stderr of each process of a group that runs a script."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    group = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port)}
    command = [sys.executable, "-c", BEGIN + script, *words]
    workers = [
        subprocess.Popen(command, env=ENVIRONMENT | group | {"RANK": str(rank)}, stderr=subprocess.PIPE, text=True)
        for rank in range(2)
    ]
    said = [worker.communicate(timeout=200)[1] for worker in workers]
    return [(worker.returncode, text) for worker, text in zip(workers, said, strict=True)]


@pytest.mark.slow
@pytest.mark.parametrize("norms", ["frozen", "learning"])
def test_two_processes_on_two_recordings_give_the_single_process_result(tmp_path, norms):
    together = tmp_path / "together.pt"
    ended = in_two_processes(TWO_RECORDINGS, str(tmp_path / "b"), str(together), norms)
    assert [code for code, _ in ended] == [0, 0], ended
    config = shared_config(frozen=norms == "frozen")
    alone = train(network(), METADATA, [two_recordings()], config, tmp_path / "a")
    for mine, theirs in zip((alone.network, alone.averaged), torch.load(together), strict=True):
        values = {name: value.double() for name, value in mine.state_dict().items()}
        off = torch.cat([((theirs[name] - v).abs() / (1.0 + v.abs())).flatten() for name, v in values.items()])
        # The same images and terms, added up in another order. AdamW divides by the size of the gradient, so that a
        # weight whose gradient is rounding alone may differ: one of 64 in a layer by 1.7e-4 on one of two processors.
        assert (off > 1e-4).double().mean() < 1e-3 and off.max() < 1e-3


def test_parts_of_a_batch_give_the_step_of_the_whole(tmp_path):
    config = replace(shared_config(frozen=True), steps=5)
    whole = train(network(), METADATA, [two_recordings()], config, tmp_path / "whole").network.state_dict()
    divided = replace(config, accumulate=5)
    state = train(network(), METADATA, [two_recordings()], divided, tmp_path / "parts").network.state_dict()
    for name, value in whole.items():
        torch.testing.assert_close(state[name], value, rtol=1e-4, atol=1e-4, msg=name)


def test_workers_draw_the_same_batches(whole, tmp_path):
    assert_same(whole, run(tmp_path, replace(CONFIG, workers=2)))


class _Unreadable(Supervised):
    def draw(self, slots):
        if slots[0].step == 3:
            raise SourceError("flight/3.png: unreadable")
        return super().draw(slots)


def test_error_in_a_worker_is_that_error(tmp_path):
    signals = [_Unreadable([Source("made", views(), 1.0)], METADATA)]
    with pytest.raises(SourceError, match=r"^flight/3\.png: unreadable$"):
        train(network(), METADATA, signals, replace(CONFIG, workers=1), tmp_path)
    assert saved_step(tmp_path / "last.pt") == 3


class _KilledAt3(Supervised):
    def draw(self, slots):
        if slots[0].step == 3:
            os.kill(os.getpid(), signal_number.SIGKILL)
        return super().draw(slots)


def test_killed_worker_ends_training_in_one_line_and_loses_no_step(whole, tmp_path):
    signals = [_KilledAt3([Source("made", views(), 1.0)], METADATA)]
    with pytest.raises(WorkerError, match=r"a process that draws batches ended \(.*\); fewer --workers take less"):
        train(network(), METADATA, signals, replace(CONFIG, workers=1), tmp_path, lambda n: {"score": 1.0})
    assert_same(whole, run(tmp_path))


def test_interrupt_in_a_forward_pass_leaves_the_statistics_of_the_step_before(whole, tmp_path):
    class Interrupted(Hooks):
        def on_losses(self, state, drawn):
            if state.step == 4:
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, hooks=[Interrupted()])
    assert saved_step(tmp_path / "last.pt") == 4
    assert_same(whole, run(tmp_path))


@pytest.mark.parametrize("device", ["cuda", "mps"])
def test_device_that_is_not_there_is_refused_in_one_line(tmp_path, device):
    if (torch.cuda if device == "cuda" else torch.backends.mps).is_available():
        pytest.skip(f"{device} is there")
    with pytest.raises(ConfigError, match=f"--device {device}: this torch .* finds no such device; use --device cpu"):
        run(tmp_path, replace(CONFIG, device=device))


def depth_of(state):
    """Log depth of the first view by what was learnt, on the processor."""
    with torch.no_grad():
        return state.averaged.cpu().eval().predict(image_tensor(views()[0].image, METADATA)[None]).log_depth


def test_bfloat16_learns_the_same_as_float32(tmp_path):
    there, here = (depth_of(run(tmp_path / f"{amp}", replace(CONFIG, amp=amp))) for amp in (True, False))
    assert 0.0 < float((there - here).abs().mean()) < 0.06


@pytest.mark.parametrize("device", ["cuda", "mps"])
@pytest.mark.parametrize("amp", [False, True])
def test_training_on_a_gpu_goes_on_anywhere(tmp_path, device, amp):
    if not (torch.cuda if device == "cuda" else torch.backends.mps).is_available():
        pytest.skip(f"no {device} device here")
    config = replace(CONFIG, device=device, amp=amp)
    state = run(tmp_path / "gpu", config)
    assert next(state.network.parameters()).device.type == device
    # Adam moves a weight whose gradient is all rounding by as much as any other one: what was learnt is compared.
    there, here = (depth_of(learnt) for learnt in (state, run(tmp_path / "cpu")))
    mean = float((there - here).abs().mean())
    assert mean < (0.06 if amp else 0.02)  # bfloat16 on a processor: .022; a GPU's float32 convolutions are TF32
    assert run(tmp_path / "gpu", replace(CONFIG, steps=8)).step == 8, "a processor takes over"


def test_float16_leaves_out_steps_that_overflow(tmp_path, monkeypatch):
    """The first scale, 65536, is too large for these losses; the scaler halves it until it fits."""
    half = Arithmetic(torch.device("cpu"), torch.float16)
    monkeypatch.setattr(loop, "arithmetic", lambda device, amp: half)
    real = torch.amp.GradScaler
    monkeypatch.setattr(torch.amp, "GradScaler", lambda device, enabled: real(device, 2.0**22, enabled=enabled))
    scales = []

    class Record(Hooks):
        def on_step(self, state, losses):
            scales.append(state.scaler.get_scale())

    before = network().state_dict()
    state = run(tmp_path, replace(CONFIG, steps=20, validate_every=20), [Record()])
    assert scales[0] == 2.0**21, "halved by an overflow"
    assert scales[-1] == scales[-2], "until it fits"
    assert not torch.equal(state.network.state_dict()["head.weight"], before["head.weight"])
    assert all(torch.isfinite(p).all() for p in state.network.parameters())
    again = run(tmp_path, replace(CONFIG, steps=21, validate_every=21))
    assert again.scaler.get_scale() == scales[-1], "a resume remembers it"


@pytest.mark.slow
def test_loss_that_is_not_finite_in_one_process_stops_all_with_its_name(tmp_path):
    ended = in_two_processes(POISONED, str(tmp_path / "out"))
    named = signal().draw([Slot(0, 3, 1)])[1][0]
    for code, said in ended:
        assert code == 1
        assert f"step 3: loss supervised/l1 is not finite for {named}; " in said
        assert "last.pt holds step 2, the last good one" in said


@pytest.mark.slow
def test_stop_that_one_process_asks_for_ends_all_after_the_same_step(tmp_path):
    for code, said in in_two_processes(STOPPED, str(tmp_path / "out")):
        assert code == 0
        assert "asked for by the second at 2" in said


def test_interrupt_in_the_validation_is_validated_after_the_resume(whole, tmp_path):
    def interrupted(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(network(), METADATA, [signal()], CONFIG, tmp_path / "stopped", interrupted)
    assert saved_step(tmp_path / "stopped" / "last.pt") == 3
    assert_same(whole, run(tmp_path / "stopped"))


def test_state_of_another_network_is_named(tmp_path):
    run(tmp_path)
    with pytest.raises(WeightsError, match=r"last\.pt: .*another network"):
        train(SmallDepth(width=16), METADATA, [signal()], CONFIG, tmp_path)


def test_finished_run_is_not_trained_further(tmp_path):
    run(tmp_path)
    before = (tmp_path / "final.safetensors").read_bytes()
    assert run(tmp_path).step == 6
    assert (tmp_path / "final.safetensors").read_bytes() == before
    assert read_header(tmp_path / "final.safetensors") == METADATA


@pytest.mark.slow
def test_one_batch_is_learnt_almost_to_zero(tmp_path):
    weights = SupervisedWeights(uncertainty=0.0, gradient=0.1)
    one = Supervised([Source("one", views(1), 1.0)], METADATA, STILL, weights)
    torch.manual_seed(0)
    wide = build_network(fast := replace(METADATA, variant=Variant.SKIPADD.value), Widths((8,) + (16,) * 13, (16,) * 5))
    config = TrainConfig(steps=250, batch=1, lr=2e-2, encoder_lr=5e-3, frozen_stages=0, warmup_steps=10, weight_decay=0)
    record = At()
    train(wide, fast, [one], config, tmp_path, hooks=[record])
    losses = [named["supervised/l1"] for named in record.losses]
    assert losses[0] > 0.5
    assert np.mean(losses[-20:]) < 0.03


def test_learning_rate_rises_then_falls():
    factors = [learning_rate_factor(i, TrainConfig(steps=100, warmup_steps=10)) for i in range(100)]
    assert factors[0] == pytest.approx(0.1)
    assert max(factors) == factors[9] == pytest.approx(1.0)
    assert factors[-1] == pytest.approx(0.01, abs=0.002)
    assert all(a >= b for a, b in zip(factors[9:], factors[10:], strict=False))
