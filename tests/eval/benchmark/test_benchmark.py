"""The benchmark's record, its comparison and its tables; the runs themselves are in the slow test."""

import argparse
import json

import numpy as np
import pytest
from markdown_rows import rows

from edgeslam_torch.commands.judging import bench
from edgeslam_torch.eval.benchmark.benchmark import BenchSettings, figures_of, markdown_bench, sequences
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.metrics.run_score import evaluate_run


def record(ate, **conditions):
    runs = [
        {"sequence": "tum_fr1_xyz", "seed": seed, "figures": {"ate_sim3_m": a}, "stages": {"tracking": 5.0}}
        for seed, a in enumerate(ate)
    ]
    machine = {"cpu": "some", "cores": 2, "python": "3.11"}
    own = {"format": 3, "version": "0", "commit": "abc", "made": "now", "mode": "offline", "machine": machine}
    return own | {"runs": runs, "max_frames": None} | conditions


def test_table_lists_every_run_its_median_its_noise_and_the_peers():
    cells = [line[:2] for line in rows(markdown_bench(record([0.01, 0.011, 0.013])))]
    assert cells[1:4] == [[f"edgeslam, seed {k}", ate] for k, ate in enumerate(("0.0100", "0.0110", "0.0130"))]
    assert [row[1] for row in cells[4:6]] == ["0.0110", "0.0025"], "2 sqrt(2 s^2 / 3), s = 0.0015"
    assert any(system.startswith("ORB-SLAM2") and ate == "0.0098 0.0094 0.1562 0.0100 0.0099" for system, ate in cells)


def test_only_recordings_at_camera_rate_are_benchmarked(run_folder, tmp_path):
    run_folder(tmp_path / "a")
    poses = (tmp_path / "truth.txt").read_text()
    for name, step in (("fast", 1), ("slow", 3)):
        folder = tmp_path / "data" / name
        folder.mkdir(parents=True)
        (folder / "groundtruth.txt").write_text(poses)
        stamps = np.loadtxt(tmp_path / "truth.txt")[::step, 0]  # 20 and 6.7 Hz
        (folder / "rgb.txt").write_text("".join(f"{t:.6f} rgb/{t:.6f}.png\n" for t in stamps))
    (tmp_path / "data" / "no_truth").mkdir()
    assert list(sequences(BenchSettings(tmp_path / "data"))) == ["fast"]
    with pytest.raises(EvaluationError, match="no such folder"):
        sequences(BenchSettings(tmp_path / "nowhere"))


def run_bench(*words):
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    return bench.main(parser.parse_args([str(w) for w in words]))


def test_compare_reads_two_results(tmp_path, capsys):
    for name, ate in (("a", 0.010), ("b", 0.020)):
        (tmp_path / f"{name}.json").write_text(json.dumps(record([ate, ate])))
    assert run_bench("--compare", tmp_path / "a.json", tmp_path / "b.json") == 0
    assert "0.0100 -> 0.0200 x2.00 !" in capsys.readouterr().out
    (tmp_path / "b.json").write_text('{"format": 0, "runs": []}')  # of another version
    with pytest.raises(EvaluationError, match=r"b\.json"):
        run_bench("--compare", tmp_path / "a.json", tmp_path / "b.json")


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(1200)
def test_synthetic_flight_is_run_once_and_judged(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("EDGESLAM_DATA", raising=False)
    words = ("--seeds", 1, "--max-frames", 40, "--out", tmp_path / "bench")
    assert run_bench(*words) == 0
    assert "edgeslam, seed 0" in capsys.readouterr().out
    (run,) = json.loads((tmp_path / "bench" / "bench.json").read_text())["runs"]
    assert run["figures"]["coverage"] > 0.5 and run["figures"]["cpu_orb"] > 0
    within = json.loads((tmp_path / "bench" / "synthetic_seed0" / "summary.json").read_text())["cpu_ms_per_frame"]
    assert run["figures"]["cpu_ms_per_frame"] > within  # start-up counts
    assert run_bench(*words) == 0
    assert json.loads((tmp_path / "bench" / "bench.json").read_text())["runs"] == [run]


def test_figures_are_plain_numbers(run_folder, tmp_path):
    truth = run_folder(tmp_path / "a")
    found = figures_of(evaluate_run(tmp_path / "a", truth))
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["ate_sim3_m"] is not None and found["cpu_ms_per_frame"] == 33.1
