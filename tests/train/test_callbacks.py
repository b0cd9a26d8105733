"""TensorBoard holds each step once, whatever was interrupted."""

from collections import Counter
from dataclasses import replace

import pytest
from small_depth import METADATA, VIEW, learn
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer import event_file_writer

from edgeslam_torch.train.callbacks import ProgressBar, TensorBoard
from edgeslam_torch.train.hooks import Hooks
from edgeslam_torch.train.state import TrainConfig

CONFIG = TrainConfig(steps=9, batch=1, warmup_steps=1, validate_every=3, checkpoint_every=4)


class _Killed(Hooks):
    """Ends like a killed process: the last steps are not saved."""

    def __init__(self, step):
        self.step = step

    def on_step(self, state, losses):
        if state.step == self.step:
            state.shown = None  # what a rescue would need
            raise KeyboardInterrupt


def run(out, config, *more):
    return learn(out, config, [ProgressBar(), TensorBoard(out / "tensorboard", METADATA, [VIEW]), *more])


def test_steps_are_in_tensorboard_once_after_interrupts_and_more_steps(tmp_path, monkeypatch):
    # Files of one second are read in the order of their names, where a counter of the process puts 10 before 9; runs
    # of their own have seconds of their own.
    monkeypatch.setattr(event_file_writer, "_global_uid", event_file_writer.AtomicCounter(1000))
    for step in (2, 7):  # before the first checkpoint, and between two
        with pytest.raises(KeyboardInterrupt):
            run(tmp_path, CONFIG, _Killed(step))
    run(tmp_path, CONFIG)
    run(tmp_path, replace(CONFIG, steps=11))
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    for tag, expected in (("loss/sum", range(1, 12)), ("lr", range(1, 12)), ("validation/score", [3, 6, 9, 11])):
        assert Counter(event.step for event in events.Scalars(tag)) == Counter(expected), tag
    assert [event.step for event in events.Images("view 0")] == [3, 6, 9, 11]
