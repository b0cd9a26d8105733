"""Hooks of users: when they are called, what they may change, how they are named, and what a resume makes of them."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_depth import METADATA, VIEW, learn, small_depth

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.train import (
    Data,
    DepthFolder,
    Hooks,
    TrainConfig,
    finetune,
    named_hooks,
    out_folder,
)

CONFIG = TrainConfig(steps=4, batch=2, warmup_steps=1, validate_every=2, checkpoint_every=2, freeze_norm=True)
EXAMPLES = Path(__file__).parents[2] / "examples" / "training_hooks.py"


def run(out, *hooks, config=CONFIG):
    return learn(out, config, hooks)


class Diary(Hooks):
    """What happens, in order."""

    def __init__(self):
        self.seen = []

    def on_start(self, state, config):
        self.seen.append("start")

    def on_losses(self, state, drawn):
        assert drawn.signal == "supervised"
        assert drawn.batch["image"].shape == (2, 3, 32, 64)
        assert drawn.predicted.log_depth.shape == (2, 1, 32, 64) and drawn.predicted.log_depth.requires_grad
        self.seen.append("losses " + ",".join(drawn.losses))

    def on_step(self, state, losses):
        self.seen.append(f"step {state.step}")

    def on_validation(self, state, metrics):
        self.seen.append(f"validation {metrics['score']:g}")

    def on_end(self, state, reason):
        self.seen.append(f"end: {reason}")

    def close(self):
        self.seen.append("close")


class Zero(Hooks):
    """Nothing is learnt but what it says."""

    def on_losses(self, state, drawn):
        for name in list(drawn.losses):
            del drawn.losses[name]
        drawn.losses["three"] = torch.full((len(drawn.batch["image"]),), 3.0)
        drawn.losses["own"] = (drawn.predicted.log_depth - 1.0).square().flatten(1).mean(1)


class StopAt(Hooks):
    def __init__(self, step):
        self.step = step

    def on_step(self, state, losses):
        if state.step == self.step:
            state.stop = "seen enough"


def test_events_come_in_the_order_that_is_written_down(tmp_path):
    diary = Diary()
    run(tmp_path, diary)
    step = "losses l1,gradient,uncertainty"
    two = [[step, "step 1", step, "step 2"], [step, "step 3", step, "step 4"]]
    assert diary.seen == ["start", *two[0], "validation 1", *two[1], "validation 1", "end: all steps done", "close"]


def test_own_loss_is_what_is_learnt_and_reported(tmp_path):
    losses = []

    class Keep(Hooks):
        def on_step(self, state, given):
            losses.append(given)

    run(tmp_path, Zero(), Keep(), config=replace(CONFIG, steps=12, lr=0.05))
    assert [list(found) for found in losses] == [["supervised/three", "supervised/own"]] * 12
    assert losses[0]["supervised/three"] == 3.0, "the mean over images"
    assert losses[-1]["supervised/own"] < 0.5 * losses[0]["supervised/own"]


@pytest.mark.parametrize(
    ("value", "words"),
    [(torch.tensor(1.0), r"of shape \(\)"), (torch.ones(2, 1), r"of shape \(2, 1\)"), (1.0, "a float")],
)
def test_loss_that_is_not_one_value_an_image_is_said(tmp_path, value, words):
    class Wrong(Hooks):
        def on_losses(self, state, drawn):
            drawn.losses["own"] = value

    with pytest.raises(
        ConfigError, match=rf"hook Wrong: loss 'own' must be one value an image, \(2,\), and is {words}"
    ):
        run(tmp_path, Wrong())


def test_stop_is_validated_saved_and_said(tmp_path):
    diary = Diary()
    state = run(tmp_path, StopAt(3), diary)
    assert diary.seen[-4:] == ["step 3", "validation 1", "end: seen enough", "close"]
    assert state.step == 3 and state.history[-1]["step"] == 3
    # Without the hook the training goes on where it ended.
    again = Diary()
    assert run(tmp_path, again).step == 4
    assert again.seen[2] == "step 4"


def test_fine_tuning_calls_hooks_and_is_not_resumed_with_other_losses(tmp_path):
    data = Data(labelled=[DepthFolder("kitchen", (VIEW,) * 3, ())])

    def tune(*hooks, steps=2):
        with out_folder(tmp_path / "out") as out:
            return finetune(small_depth(), METADATA, data, replace(CONFIG, steps=steps), out, hooks=hooks).steps

    assert tune(StopAt(9), steps=2) == 2
    assert tune(steps=3) == 3  # who only watches may come and go
    with pytest.raises(ConfigError, match=r"losses_of: None then, \['.*test_hooks:Zero'\] now"):
        tune(Zero(), steps=4)


def test_hooks_are_found_in_files_and_modules(tmp_path, monkeypatch):
    (tmp_path / "my_hooks_here.py").write_text(
        "from edgeslam_torch.train import Hooks\n"
        "class Mine(Hooks):\n    def __init__(self, word='default'): self.word = word\n"
        "named = Mine('named')\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.path", ["/nowhere"])
    found = named_hooks(["my_hooks_here.py:Mine", "my_hooks_here:named", f"{tmp_path}/my_hooks_here.py:named"])
    assert [hook.word for hook in found] == ["default", "named", "named"]


@pytest.mark.parametrize(
    "name",
    ["Mine", "hooks.py:", "nothing.py:Mine", "no.such.module:Mine", "broken.py:Mine", "good.py:Other", "good.py:Needs"]
    + ["good.py:number"],
)
def test_hook_that_is_none_is_an_error_of_one_line(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    Path("broken.py").write_text("1 / 0")
    Path("good.py").write_text(
        "from edgeslam_torch.train import Hooks\nnumber = 3\nclass Needs(Hooks):\n    def __init__(self, word): pass\n"
    )
    with pytest.raises(ConfigError, match=f"^--hook {name}: [^\n]*$"):
        named_hooks([name])


def test_examples_do_what_they_say(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ("OwnLoss", "CsvLog", "SampleImages", "stop")
    hooks = named_hooks([f"{EXAMPLES}:{name}" for name in names])
    hooks[2].every, hooks[3].metric, hooks[3].below = 2, "abs_rel", 0.4
    state = run(tmp_path / "out", *hooks)
    assert (state.step, state.stop) == (2, "abs_rel is below 0.4")
    rows = [row.split(",") for row in Path("losses.csv").read_text().split()]
    assert [row[0] for row in rows] == ["1"] * 4 + ["2"] * 4
    assert "supervised/smooth" in {row[1] for row in rows}
    assert sorted(path.name for path in Path("samples").iterdir()) == ["000002-0.png", "000002-1.png"]
