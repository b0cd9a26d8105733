"""``edgeslam finetune``: what the folder holds is what was trained on, and the better weights are kept."""

import io
import json
import os
import shutil
import signal
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from depth_folder import write_folder
from small_depth import narrow_fastdepth

from edgeslam_torch import cli
from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train import loop
from edgeslam_torch.train.callbacks import ProgressBar
from edgeslam_torch.train.state import saved_step
from edgeslam_torch.writers.own_folder import FolderLock

METADATA = Metadata(
    input_height=32, input_width=64, focal_px=60.0, data=("rooms",), licence="Apache-2.0", metrics={"abs_rel": 0.2}
)
COMMON = ("--batch", "2", "--lr", "0.01")

Finetune = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """Two recordings with depth, and weights to begin with."""
    root = tmp_path_factory.mktemp("recordings")
    write_folder(root / "kitchen")
    write_folder(root / "hall", 8)
    network = narrow_fastdepth(METADATA)
    save_checkpoint(network, METADATA, root / "start.safetensors")
    return root


@pytest.fixture
def finetune(recordings, tmp_path):
    """Runs the command on named recordings into ``tmp_path/out``; returns exit code, stdout and stderr."""

    def call(*words, steps=4, out=tmp_path / "out"):
        return _finetune(recordings, *words, steps=steps, out=out)

    return call


def _finetune(recordings, *words, steps, out):
    given = [str(recordings / w) if (recordings / w).exists() else w for w in words]
    if "--weights" not in given:
        given += ["--weights", str(recordings / "start.safetensors")]
    stdout, stderr = io.StringIO(), io.StringIO()
    with redirect_stdout(stdout), redirect_stderr(stderr):
        code = cli.main(["finetune", *COMMON, *given, "--out", str(out), "--steps", str(steps)])
    return code, stdout.getvalue(), stderr.getvalue()


@pytest.fixture(scope="module")
def four_steps(recordings):
    """A whole run on the kitchen, shared by the tests, and its output."""
    folder = recordings / "four steps"
    code, stdout, _ = _finetune(recordings, "kitchen", steps=4, out=folder)
    assert code == 0
    return folder, stdout


@pytest.fixture
def trained(four_steps, tmp_path):
    """A copy of that run in ``tmp_path/out``."""
    return Path(shutil.copytree(four_steps[0], tmp_path / "out"))


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def refused(answer, *words):
    code, _, stderr = answer
    assert code == 1
    errors = [line for line in stderr.splitlines() if line.startswith("edgeslam: error:")]
    assert len(errors) == 1, stderr
    for word in words:
        assert word in errors[0]


@pytest.mark.slow
def test_before_and_after_are_reported_and_weights_say_what_they_are(finetune, recordings, tmp_path):
    folder = shutil.copytree(recordings / "kitchen", tmp_path / "kitchen")
    (folder / "rgb" / "3.png").write_bytes(b"broken")
    code, stdout, stderr = finetune(str(folder), steps=60)
    assert code == 0
    assert "kitchen: 11 images with depth" in stdout
    assert "1 images or depth maps left out" in stderr
    assert "rgb/3.png: unreadable" in stderr
    rows = [line.split("|") for line in stdout.splitlines() if line.startswith(("| before", "| after"))]
    assert float(rows[1][3]) < float(rows[0][3])
    metadata = load_checkpoint(tmp_path / "out" / "weights.safetensors")[1]
    assert metadata.data == ("rooms", "kitchen")
    assert metadata.licence == "Apache-2.0; fine-tuned on the user's data"
    assert metadata.metrics["abs_rel_scaled"] == pytest.approx(float(rows[1][3]), abs=0.02)
    assert "the best validated" in metadata.notes
    umask = os.umask(0)
    os.umask(umask)
    modes = {p.name: oct(p.stat().st_mode & 0o777) for p in (tmp_path / "out").iterdir() if p.is_file()}
    assert set(modes.values()) == {oct(0o666 & ~umask)}, modes


def test_other_data_into_the_same_folder_is_refused_and_nothing_changes(finetune, trained, tmp_path):
    before = contents(tmp_path / "out")
    refused(finetune("hall"), "data: kitchen (depth) then, hall (depth) now", "--overwrite")
    refused(finetune("hall", "--resume"), "data: kitchen")
    refused(finetune("kitchen", "--validate", "hall"), "validation: none then, hall now")
    refused(finetune("kitchen", "--seed", "3"), "seed: 0 then, 3 now")
    refused(finetune("kitchen", "--weights", "out/weights.safetensors"), "out/weights.safetensors")
    assert contents(tmp_path / "out") == before


@pytest.mark.slow
def test_data_that_changed_on_disk_is_refused(finetune, recordings, tmp_path):
    folder = shutil.copytree(recordings / "kitchen", tmp_path / "kitchen")
    finetune(str(folder), steps=1)
    before = contents(tmp_path / "out")
    cv2.imwrite(str(folder / "rgb" / "4.png"), np.zeros((48, 64, 3), np.uint8))
    refused(finetune(str(folder), steps=2), "images of kitchen: 12, ")
    (folder / "rgb" / "4.png").unlink()
    refused(finetune(str(folder), steps=2), "images of kitchen: 12, ", " then, 11, ")
    assert contents(tmp_path / "out") == before


def test_same_command_again_trains_nothing_and_says_so(finetune, four_steps, trained, tmp_path):
    first = four_steps[1].replace(str(four_steps[0]), str(trained))
    before = contents(tmp_path / "out")
    code, second, _ = finetune("kitchen")
    assert code == 0
    assert "nothing was left to train" in second
    assert first.splitlines()[-1] in second
    assert contents(tmp_path / "out") == before


def test_more_steps_go_on_and_fewer_are_refused(finetune, trained, tmp_path):
    code, stdout, _ = finetune("kitchen", steps=6)
    assert code == 0
    assert "resumes after step 4" in stdout
    assert saved_step(tmp_path / "out" / "last.pt") == 6
    curve = [json.loads(line)["step"] for line in (tmp_path / "out" / "curve.jsonl").read_text().splitlines()]
    assert curve == [*range(5), *range(5, 7)]
    refused(finetune("kitchen", steps=3), "has 6 steps already, so it cannot end after 3")
    sessions = json.loads((tmp_path / "out" / "finetune.json").read_text())["sessions"]
    assert [(s["from_step"], s["steps"]) for s in sessions] == [(0, 4), (4, 6)]


@pytest.mark.slow
def test_resume_takes_another_rate_and_needs_something_to_resume(finetune, trained, tmp_path):
    refused(finetune("kitchen", "--resume", out=tmp_path / "new"), "nothing to resume")
    assert not (tmp_path / "new").exists()
    refused(finetune("kitchen", "--lr", "0.001", steps=6), "lr: 0.01 then, 0.001 now", "--resume")
    assert finetune("kitchen", "--lr", "0.001", "--resume", steps=6)[0] == 0


@pytest.mark.slow
def test_overwrite_begins_anew_and_keeps_the_old_one_until_the_data_is_read(finetune, tmp_path):
    finetune("kitchen", steps=6)
    before = contents(tmp_path / "out")
    broken = write_folder(tmp_path / "broken", 2)
    (broken / "depth.txt").write_text("5.0 depth/0.png\n")
    refused(finetune(str(broken), "--overwrite"), "no image with depth")
    assert contents(tmp_path / "out") == before
    assert finetune("hall", "--overwrite")[0] == 0
    assert load_checkpoint(tmp_path / "out" / "weights.safetensors")[1].data == ("rooms", "hall")
    assert saved_step(tmp_path / "out" / "last.pt") == 4


def test_files_that_no_finetuning_wrote_are_left_alone(finetune, recordings, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "weights.safetensors").write_bytes(b"somebody's")
    for words in (("kitchen",), ("kitchen", "--overwrite")):
        refused(finetune(*words), "holds weights.safetensors, but no finetune.json")
    assert contents(tmp_path / "out") == {"weights.safetensors": b"somebody's"}
    own = shutil.copytree(recordings / "hall", tmp_path / "hall")
    before = contents(own)
    refused(finetune(str(own), out=own), "is a training folder; give another --out")
    refused(finetune("kitchen", out=own), "holds rgb.txt")
    assert contents(own) == before


def test_out_that_cannot_be_written_is_one_line(finetune, tmp_path):
    (tmp_path / "file").write_text("a file")
    refused(finetune("kitchen", out=tmp_path / "file"), str(tmp_path / "file"), "exists")
    refused(finetune("kitchen", out=tmp_path / "file" / "below"), "Not a directory")
    (tmp_path / "out" / "last.pt").mkdir(parents=True)
    refused(finetune("kitchen"), "last.pt")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (("--lr", "0"), "--lr must be above 0"),
        (("--batch", "0"), "--batch must be at least 1"),
        (("--threads", "0"), "--threads must be 1 to 256"),
        (("--validate", "kitchen"), "is used for training and cannot validate"),
        (("--max-frames", "0"), "--max-frames must be at least 1"),
        (("gone",), "gone: no such recording"),
        (("--validate", "start.safetensors"), "no recording with depth"),
    ],
)
def test_mistakes_are_named_before_anything_is_written(finetune, tmp_path, wrong, said):
    refused(finetune("kitchen", *wrong), said)
    refused(finetune("kitchen", steps=0), "--steps must be at least 1")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_what_made_nothing_better_keeps_the_weights_it_began_with(finetune, recordings, tmp_path):
    finetune("kitchen", steps=40, out=tmp_path / "good")
    good = tmp_path / "good" / "weights.safetensors"
    noise = shutil.copytree(recordings / "kitchen", tmp_path / "noise")
    rng = np.random.default_rng(1)
    for path in (noise / "depth").iterdir():
        cv2.imwrite(str(path), rng.integers(500, 9000, (48, 64)).astype(np.uint16))
    code, stdout, stderr = finetune(
        str(noise), "--validate", "kitchen", "--weights", str(good), "--lr", "0.05", steps=4
    )
    assert code == 0
    assert "WARNING: fine-tuning improved nothing (median-scaled AbsRel" in stderr
    assert "the weights that fine-tuning began with, unchanged" in stdout
    before, after = (load_checkpoint(p) for p in (good, tmp_path / "out" / "weights.safetensors"))
    for (name, a), b in zip(before[0].state_dict().items(), after[0].state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    assert after[1].data == before[1].data == ("rooms", "kitchen")
    assert (after[1].metrics, after[1].licence) == (before[1].metrics, before[1].licence)
    assert "fine-tuning improved nothing" in after[1].notes
    assert json.loads((tmp_path / "out" / "finetune.json").read_text())["outcome"]["kept_step"] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_signal_says_what_is_kept_and_the_same_command_goes_on(finetune, four_steps, tmp_path, monkeypatch, number):
    def stopped(self, state, losses):
        if state.step == 3:
            signal.raise_signal(number)

    before = signal.getsignal(number)
    with monkeypatch.context() as patch:
        patch.setattr(ProgressBar, "on_step", stopped)
        code, _, stderr = finetune("kitchen")
    assert code == 130
    assert signal.getsignal(number) is before
    assert stderr.splitlines()[-1].endswith("holds step 3, and the same command resumes from there")
    whole, resumed = four_steps[0], tmp_path / "out"
    assert "resumes after step 3" in finetune("kitchen")[1]
    for name in ("weights.safetensors", "final.safetensors", "curve.jsonl"):
        assert (whole / name).read_bytes() == (resumed / name).read_bytes(), name


def test_hooks_of_the_command_line_take_part(finetune, tmp_path):
    hooks = tmp_path / "hooks_of_a_user.py"
    hooks.write_text(
        "from edgeslam_torch.train import Hooks\n"
        "class Stop(Hooks):\n"
        "    def on_step(self, state, losses):\n        state.stop = 'enough'\n"
    )
    refused(finetune("kitchen", "--hook", f"{hooks}:Other"), "--hook")
    assert not (tmp_path / "out").exists()
    code, _, _ = finetune("kitchen", "--hook", f"{hooks}:Stop")
    assert code == 0
    assert saved_step(tmp_path / "out" / loop.LAST) == 1
    record = json.loads((tmp_path / "out" / "finetune.json").read_text())
    assert record["given"]["hooks"] == ["hooks_of_a_user:Stop"]


def test_other_weights_are_refused(finetune, trained, tmp_path):
    network = narrow_fastdepth(METADATA, seed=1)
    save_checkpoint(network, METADATA, tmp_path / "other.safetensors")
    refused(finetune("kitchen", "--weights", str(tmp_path / "other.safetensors")), "weights: ")
    own = tmp_path / "out" / "weights.safetensors"
    refused(finetune("kitchen", "--weights", str(own), "--overwrite"), "would be overwritten")
    assert own.is_file()


@pytest.mark.slow
def test_moved_data_and_folder_go_on(finetune, recordings, tmp_path):
    folder = shutil.copytree(recordings / "kitchen", tmp_path / "here" / "kitchen")
    finetune(str(folder), out=tmp_path / "first")
    shutil.move(tmp_path / "here", tmp_path / "there")
    shutil.move(tmp_path / "first", tmp_path / "second")
    code, stdout, _ = finetune(str(tmp_path / "there" / "kitchen"), out=tmp_path / "second", steps=6)
    assert code == 0
    assert "resumes after step 4" in stdout


def test_damaged_record_is_named(finetune, trained, tmp_path):
    inputs = '{"given": {"weights": 1, "data": 5}'
    other_outcome = f'{inputs}, "sessions": [], "outcome": {{"steps": 4}}}}'
    for text in ("", "{}", "[1]", inputs + "}", other_outcome, "[" * 100_000):
        (tmp_path / "out" / "finetune.json").write_text(text)
        refused(finetune("kitchen"), "finetune.json: unreadable")


def test_two_at_the_same_time_are_refused(finetune, tmp_path):
    (tmp_path / "out").mkdir()
    lock = FolderLock(tmp_path / "out")
    refused(finetune("kitchen"), f"process {os.getpid()}")
    lock.release()


@pytest.mark.slow
def test_depth_too_far_to_validate_on_is_learnt_from_all_the_same(finetune, recordings, tmp_path):
    far = shutil.copytree(recordings / "kitchen", tmp_path / "far")
    for path in (far / "depth").iterdir():
        cv2.imwrite(str(path), np.full((48, 64), 20_000, np.uint16))
    code, stdout, _ = finetune(str(far))
    assert code == 0
    assert "not validated" in stdout
    refused(finetune("kitchen", "--validate", str(far), out=tmp_path / "other"), "no depth between 0.1 and 10 m")
