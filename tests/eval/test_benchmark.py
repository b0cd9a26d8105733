"""The benchmark's record, its comparison and its tables; the runs themselves are in the slow test."""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edgeslam_torch.commands import bench
from edgeslam_torch.eval.benchmark import (
    METRICS,
    compare,
    figures_of,
    find_sequences,
    markdown_bench,
    markdown_compare,
    read_peers,
    read_record,
)
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.run_score import evaluate_run


def record(ate: list[float], cpu: list[float]) -> dict[str, Any]:
    runs = [
        {
            "sequence": "tum_fr1_xyz",
            "seed": k,
            "figures": {"ate_sim3_m": a, "cpu_ms_per_frame": c, "coverage": 1.0},
            "stages": {"tracking": 5.0},
            "error": "",
        }
        for k, (a, c) in enumerate(zip(ate, cpu, strict=True))
    ]
    machine = {"cpu": "some", "cores": 2, "python": "3.11"}
    return {
        "format": 1,
        "version": "0",
        "commit": "abc",
        "made": "now",
        "mode": "offline",
        "machine": machine,
        "runs": runs,
    }


def verdicts(a: dict[str, Any], b: dict[str, Any]) -> dict[str, str]:
    return {row["metric"]: row["verdict"] for row in compare(a, b)}


def test_change_within_the_scatter_of_the_seeds_is_no_change() -> None:
    found = verdicts(record([0.010, 0.012, 0.014], [30, 31, 32]), record([0.011, 0.013, 0.015], [31, 32, 33]))
    assert found == {"ate_sim3_m": "same", "coverage": "same", "cpu_ms_per_frame": "same"}


def test_change_beyond_the_scatter_is_named_with_its_direction() -> None:
    a, b = record([0.010, 0.0101, 0.0102], [30, 31, 32]), record([0.013, 0.0131, 0.0132], [20, 21, 22])
    assert verdicts(a, b) == {"ate_sim3_m": "worse", "coverage": "same", "cpu_ms_per_frame": "better"}
    assert verdicts(b, a) == {"ate_sim3_m": "better", "coverage": "same", "cpu_ms_per_frame": "worse"}
    assert "worse" in markdown_compare(compare(a, b))


def test_one_seed_is_judged_by_the_floors() -> None:
    found = verdicts(record([0.0100], [30.0]), record([0.0102], [32.0]))
    assert found["ate_sim3_m"] == "same" and found["cpu_ms_per_frame"] == "same"


def test_table_lists_every_run_its_median_and_the_peers() -> None:
    text = markdown_bench(record([0.0100, 0.0110, 0.0130], [30, 31, 32]))
    assert text.count("| edgeslam, seed") == 3
    assert "median of 3** | 0.0110" in text
    assert "(±) | 0.0025 |" in text, "2 sqrt(2 s^2 / 3), s = 0.0015"
    assert "ORB-SLAM2" in text and "0.0098 0.0094 0.1562" in text
    assert "tracking 5.0" in text


def test_what_is_not_the_whole_sequence_is_said() -> None:
    text = markdown_bench(record([0.01], [30]) | {"max_frames": 80, "took_s": 90.0})
    assert "only the first 80 frames" in text and "1.5 minutes" in text
    assert "| DROID-SLAM, tum_fr1 (average of 9) [" in text


def test_peers_state_source_and_conditions() -> None:
    names = {m.name for m in METRICS} | {"ate_m", "system", "sequence", "source", "conditions"}
    for peer in read_peers():
        assert peer["source"] and peer["conditions"] and peer["ate_m"], peer
        assert set(peer) <= names, f"{peer['system']} has a figure that no table shows"


def test_figures_are_plain_numbers(run_folder: Callable[..., Path], tmp_path: Path) -> None:
    truth = run_folder(tmp_path / "a")
    found = figures_of(evaluate_run(tmp_path / "a", truth))
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["ate_sim3_m"] is not None and found["cpu_ms_per_frame"] == 33.1


def test_only_recordings_at_camera_rate_are_benchmarked(run_folder: Callable[..., Path], tmp_path: Path) -> None:
    run_folder(tmp_path / "a")
    poses = (tmp_path / "truth.txt").read_text()
    for name, step in (("fast", 1), ("slow", 3)):
        folder = tmp_path / "data" / name
        folder.mkdir(parents=True)
        (folder / "groundtruth.txt").write_text(poses)
        stamps = np.loadtxt(tmp_path / "truth.txt")[::step, 0]  # 20 and 6.7 Hz
        (folder / "rgb.txt").write_text("".join(f"{t:.6f} rgb/{t:.6f}.png\n" for t in stamps))
    (tmp_path / "data" / "no_truth").mkdir()
    assert list(find_sequences(tmp_path / "data")) == ["fast"]
    with pytest.raises(EvaluationError, match="no such folder"):
        find_sequences(tmp_path / "nowhere")


@pytest.mark.parametrize("text", [None, "not json", "[]", '{"format": 0, "runs": []}'])
def test_other_files_are_no_records(text: str | None, tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(EvaluationError, match="r.json"):
        read_record(path)


def run_bench(*words: object) -> int:
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    return bench.main(parser.parse_args([str(w) for w in words]))


def test_compare_reads_two_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, ate in (("a", 0.010), ("b", 0.020)):
        (tmp_path / f"{name}.json").write_text(json.dumps(record([ate, ate], [30, 30])))
    assert run_bench("--compare", tmp_path / "a.json", tmp_path / "b.json") == 0
    assert "| tum_fr1_xyz | ATE Sim(3) [m] | 0.0100 | 0.0200 | ±0.0003 | worse |" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_synthetic_flight_is_run_and_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("EDGESLAM_DATA", raising=False)
    assert run_bench("--seeds", 1, "--max-frames", 40, "--no-micro", "--out", tmp_path / "bench") == 0
    text = capsys.readouterr().out
    assert "### synthetic" in text and "edgeslam, seed 0" in text
    stored = read_record(tmp_path / "bench" / "bench.json")
    assert stored["runs"][0]["figures"]["coverage"] > 0.5
