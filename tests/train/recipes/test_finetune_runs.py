"""``edgeslam finetune`` on runs: the teacher's work is kept, what is of no use is named, the SLAM runs once."""

import argparse
import json
import logging
import shutil
from dataclasses import replace
from types import SimpleNamespace

import pytest
from small_depth import RUNS, narrow_fastdepth

from edgeslam_torch.commands.training import finetune as command
from edgeslam_torch.commands.training._inputs import EXIT_INTERRUPTED
from edgeslam_torch.errors import OutputError, SourceError
from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.train.recipes.finetune import Data
from edgeslam_torch.train.teachers import teach as teacher
from edgeslam_torch.train.views import posed, slam_runs
from edgeslam_torch.train.views.posed import load_run
from edgeslam_torch.train.views.slam_runs import ensure_run


def arguments(tmp_path, *words):
    if not (tmp_path / "start.safetensors").exists():
        save_checkpoint(narrow_fastdepth(), RUNS, tmp_path / "start.safetensors")
    parser = argparse.ArgumentParser()
    command.add_arguments(parser)
    fixed = ("--out", tmp_path / "out", "--weights", tmp_path / "start.safetensors", "--steps", "3", "--batch", "2")
    return parser.parse_args([str(w) for w in (*fixed, *words)])


def changed(run_folder, tmp_path):
    """A copy of the run that a test may change."""
    shutil.copytree(run_folder.parent / "recording", tmp_path / "recording")
    folder = shutil.copytree(run_folder, tmp_path / "run")
    summary = json.loads((folder / "summary.json").read_text())
    summary["source"]["path"] = str(tmp_path / "recording")
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@pytest.mark.slow
def test_run_is_learnt_from_and_validated_on_what_the_teacher_measured(run_folder, tmp_path, capsys):
    assert command.main(arguments(tmp_path, run_folder, "--from-runs", "both")) == 0
    printed = capsys.readouterr().out
    assert "11 posed images" in printed
    assert "| before |" in printed
    metadata = load_checkpoint(tmp_path / "out" / "weights.safetensors")[1]
    assert metadata.data == ("run",)
    assert list((tmp_path / "out" / "tensorboard").iterdir())


def test_run_that_tracked_nothing_is_left_out_beside_others_and_refused_alone(run_folder, tmp_path, capsys, caplog):
    lost = changed(run_folder, tmp_path)
    (lost / "status.csv").write_text((lost / "status.csv").read_text().replace("tracked", "lost"))
    with caplog.at_level(logging.WARNING):
        assert command.main(arguments(tmp_path, run_folder, lost, "--from-runs", "pairs")) == 0
    assert [m for m in caplog.messages if m.startswith("left out: ") and "only 0 frames" in m]
    assert "11 posed images" in capsys.readouterr().out
    with pytest.raises(SourceError, match="only 0 frames"):
        command.main(arguments(tmp_path, lost, "--overwrite"))


def test_folder_of_a_batch_stands_for_its_finished_flights(run_folder, tmp_path):
    batch = tmp_path / "batch"
    (batch / "flights").mkdir(parents=True)
    (batch / "batch.json").write_text("{}")
    with pytest.raises(SourceError, match="no flight of this batch finished"):
        command.main(arguments(tmp_path, batch))
    shutil.copytree(run_folder, batch / "flights" / "run")
    for name in ("jobs", "work", "pictures"):
        (batch / name).mkdir()
    for name in ("batch.csv", "index.html"):
        (batch / name).write_text("")
    for data in ([batch], sorted(batch.iterdir())):  # DIR, a shell's DIR/*
        (item,) = command.items_of(arguments(tmp_path, *data), ignore_depth=False)
        assert (item.kind, item.path) == ("run", batch / "flights" / "run")


@pytest.mark.slow
def test_pairs_alone_leave_nothing_to_validate_on_and_that_is_said(run_folder, tmp_path, capsys):
    assert command.main(arguments(tmp_path, run_folder, "--from-runs", "pairs")) == 0
    assert "weights after 3 steps, not validated" in capsys.readouterr().out
    metadata = load_checkpoint(tmp_path / "out" / "weights.safetensors")[1]
    assert metadata.data == ("run",)
    assert "not validated" in metadata.notes


@pytest.mark.slow
def test_interrupted_teacher_goes_on_where_it_was(run_folder, tmp_path, monkeypatch, capsys):
    swept = []
    real = teacher._sweep

    def sweep(sequence, i):
        if len(swept) == 5:
            swept.append(-1)
            raise KeyboardInterrupt
        swept.append(i)
        return real(sequence, i)

    monkeypatch.setattr(teacher, "_sweep", sweep)
    assert command.main(arguments(tmp_path, run_folder)) == EXIT_INTERRUPTED
    assert "no step was saved" in capsys.readouterr().err
    assert command.main(arguments(tmp_path, run_folder)) == 0
    assert [i for i in swept if i >= 0] == list(range(11)), "each view is swept once"
    monkeypatch.undo()
    assert command.main(arguments(tmp_path, run_folder, "--out", tmp_path / "whole")) == 0
    for name in ("final.safetensors", "curve.jsonl"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


@pytest.mark.slow
def test_depth_in_the_cache_is_measured_once_for_two_trainings(run_folder, tmp_path, monkeypatch):
    cached = ("--cache", tmp_path / "cache")
    assert command.main(arguments(tmp_path, run_folder, *cached)) == 0
    assert not (tmp_path / "out" / "teacher").exists()
    (entry,) = (tmp_path / "cache").iterdir()
    assert len(list(entry.glob("swept_*.npy"))) == 11
    with monkeypatch.context() as patch:
        patch.setattr(teacher, "_sweep", None)
        patch.setattr(teacher, "_completed", None)
        assert command.main(arguments(tmp_path, run_folder, *cached, "--lr", "1e-4", "--out", tmp_path / "other")) == 0
    save_checkpoint(narrow_fastdepth(), replace(RUNS, focal_px=110.0), tmp_path / "other.safetensors")
    words = (*cached, "--out", tmp_path / "third", "--weights", tmp_path / "other.safetensors")
    assert command.main(arguments(tmp_path, run_folder, *words)) == 0
    assert len(list((tmp_path / "cache").iterdir())) == 2


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("summary.json", "[]"),
        ("summary.json", '{"source": null}'),
        ("summary.json", "no json"),
        ("trajectory.txt", "1 2 3\n"),
        ("trajectory.txt", "0 0 0 0 0 0 0 0\n"),
        ("status.csv", "stamp_s,status\nlater,tracked\n"),
        ("anchors.ply", "no ply"),
    ],
)
def test_damaged_run_is_named(run_folder, tmp_path, name, content):
    folder = changed(run_folder, tmp_path)
    (folder / name).write_text(content)
    with pytest.raises(SourceError, match=f"{folder}"):
        load_run(folder)


def test_two_recordings_with_one_name_get_a_run_each(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name / "flight").mkdir(parents=True)
    given = arguments(tmp_path, tmp_path / "a" / "flight", tmp_path / "b" / "flight")
    items = command.items_of(given, ignore_depth=False)
    assert [(item.kind, item.name) for item in items] == [("recording", "flight"), ("recording", "flight-2")]


class _FakeSlam:
    """Stub of `run`: writes a minimal run folder and counts calls."""

    def __init__(self):
        self.calls = 0
        self.result = SimpleNamespace(interrupted=False, failure=None)

    def __call__(self, source, out, *_, **__):
        self.calls += 1
        out.mkdir(parents=True, exist_ok=True)
        for name in ("summary.json", "trajectory.txt"):
            (out / name).write_text("{}")
        return self.result


@pytest.fixture
def slam(monkeypatch):
    fake = _FakeSlam()
    monkeypatch.setattr(slam_runs, "run", fake)
    return fake


def test_slam_runs_once_for_the_same_recording_and_again_for_another(run_folder, tmp_path, slam):
    recording = shutil.copytree(run_folder.parent / "recording", tmp_path / "flight")
    out = tmp_path / "flight" / "tuned" / "slam" / "flight"

    def ensure(**more):
        ensure_run(recording, out, apart=tmp_path / "flight" / "tuned", **more)
        return slam.calls

    assert [ensure(), ensure()] == [1, 1]
    assert [ensure(max_frames=5), ensure(max_frames=5)] == [2, 2]
    assert ensure() == 3
    image = next((recording / "rgb").iterdir())
    image.write_bytes(image.read_bytes() + b"\0")
    assert [ensure(), ensure()] == [4, 4]
    (out / "trajectory.txt").unlink()
    assert ensure() == 5


def test_interrupted_and_failed_slam_is_not_taken_for_a_run(run_folder, tmp_path, slam):
    recording, out = run_folder.parent / "recording", tmp_path / "slam" / "flight"
    slam.result.interrupted = True
    with pytest.raises(KeyboardInterrupt):
        ensure_run(recording, out)
    slam.result = SimpleNamespace(interrupted=False, failure="disk full")
    with pytest.raises(OutputError, match="disk full"):
        ensure_run(recording, out)
    slam.result.failure = None
    ensure_run(recording, out)
    assert slam.calls == 3
    assert posed.is_run_folder(out)


def test_run_without_a_useful_pair_is_named_and_gives_no_name(run_folder, tmp_path, caplog):
    sequence = load_run(run_folder)
    still = replace(sequence, name="hovering", partners=[()] * len(sequence.views))
    with pytest.raises(SourceError, match="no run with two images of one place with a baseline"):
        Data(posed=[still]).usable()
    with caplog.at_level(logging.WARNING):
        kept = Data(posed=[still, sequence]).usable()
    assert [s.name for s in kept.posed] == ["run"]
    assert "hovering: no two images" in caplog.text


def test_first_frames_alone_are_used_when_asked(run_folder):
    assert len(load_run(run_folder, max_frames=10).views) == 9, "one of the ten is lost"
