"""The example with a loop of its own."""

import importlib.util
import sys
from pathlib import Path

import pytest
import torch
from posed_run import CAMERA
from small_depth import RUNS, narrow_fastdepth

from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.train import load_run

SCRIPT = Path(__file__).parents[2] / "examples" / "own_training_loop.py"


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("own_training_loop", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_pairs_show_the_points_where_they_are(example, run_folder):
    run = load_run(run_folder)
    pairs = example.Pairs(run, RUNS)
    assert len(pairs) == len(run.usable)
    sample = pairs[0]
    assert sample["image_i"].shape == sample["image_j"].shape == (3, 96, 128)
    seen = sample["z"] > 0
    assert (sample["uv"][seen].isfinite().all() and sample["uv"][~seen].isnan().all()) and seen.sum() > 100
    # The camera moves sideways along y of the world: to its left.
    assert sample["T_j_i"][:3, :3] == pytest.approx(torch.eye(3), abs=1e-4)
    assert float(sample["K"][0, 0]) == pytest.approx(CAMERA.fx)


@pytest.mark.slow
def test_loop_trains_and_writes_weights(example, run_folder, tmp_path, monkeypatch, capsys):
    network = narrow_fastdepth()
    save_checkpoint(network, RUNS, tmp_path / "start.safetensors")
    words = [
        str(run_folder),
        "--out",
        str(tmp_path / "mine.safetensors"),
        "--weights",
        str(tmp_path / "start.safetensors"),
    ]
    more = ["--batch", "3", "--workers", "0", "--epochs", "3", "--lr", "0.003", "--amp"]
    monkeypatch.setattr(sys, "argv", ["own_training_loop.py", *words, *more])
    example.main()
    losses = [float(line.split("loss ")[1].split()[0]) for line in capsys.readouterr().out.splitlines()]
    assert len(losses) == 3 and losses[-1] < 0.9 * losses[0]
    trained, metadata = load_checkpoint(tmp_path / "mine.safetensors")
    assert metadata.focal_px == 100.0
    assert all(torch.isfinite(p).all() for p in trained.parameters())
