"""The benchmark's record, its comparison and its tables; the runs themselves are in the slow test."""

import argparse
import json

import numpy as np
import pytest

from edgeslam_torch.commands.judging import bench
from edgeslam_torch.eval.benchmark.benchmark import BenchSettings, figures_of, markdown_bench, sequences
from edgeslam_torch.eval.benchmark.compare import compare, markdown_compare, read_record
from edgeslam_torch.eval.benchmark.machine_speed import CpuTimes, disturbance, read_cpu_times
from edgeslam_torch.eval.benchmark.probes import gather
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.metrics.run_score import evaluate_run


def record(ate, cpu):
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


def verdicts(a, b):
    return {row["metric"]: row["verdict"] for row in compare(a, b) if not row["metric"].startswith("stage:")}


def test_change_beyond_the_scatter_is_named_with_its_direction():
    a, b = record([0.010, 0.0101, 0.0102], [30, 31, 32]), record([0.013, 0.0131, 0.0132], [20, 21, 22])
    assert verdicts(a, b) == {"ate_sim3_m": "worse", "coverage": "same", "cpu_ms_per_frame": "better"}
    assert verdicts(b, a) == {"ate_sim3_m": "better", "coverage": "same", "cpu_ms_per_frame": "worse"}
    text = markdown_compare(a, b)
    assert "2 of 4 differences lie inside the noise; outside it: tum_fr1_xyz ATE Sim(3) [m] (worse)" in text


def test_one_seed_is_judged_by_the_floors():
    found = verdicts(record([0.0100], [30.0]), record([0.0102], [32.0]))
    assert found["ate_sim3_m"] == "same" and found["cpu_ms_per_frame"] == "same"


def test_table_lists_every_run_its_median_and_the_peers():
    text = markdown_bench(record([0.0100, 0.0110, 0.0130], [30, 31, 32]))
    assert text.count("| edgeslam, seed") == 3
    assert "median of 3** | 0.0110" in text
    assert "(±) | 0.0025 |" in text, "2 sqrt(2 s^2 / 3), s = 0.0015"
    assert "ORB-SLAM2" in text and "0.0098 0.0094 0.1562" in text
    assert "tracking 5.00 ±0.75" in text


def test_what_is_not_the_whole_sequence_is_said():
    text = markdown_bench(record([0.01], [30]) | {"max_frames": 80, "took_s": 90.0})
    assert "only the first 80 frames" in text and "1.5 minutes" in text
    assert "| DROID-SLAM, tum_fr1 (average of 9) [" in text


def test_figures_are_plain_numbers(run_folder, tmp_path):
    truth = run_folder(tmp_path / "a")
    found = figures_of(evaluate_run(tmp_path / "a", truth))
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["ate_sim3_m"] is not None and found["cpu_ms_per_frame"] == 33.1


def timed_record(rng, speed, scatter, factor=1.0):
    """A benchmark of three sequences at this speed of the machine whose every time scatters by ``scatter``."""

    def bout():
        work = {key: 50 / speed * noisy(0.01) for key in ("one_ms", "cpu_ms", "wall_ms")}
        return {"reference": work, "solver": {"all terms": 150 * factor / speed * noisy(scatter)}}

    def noisy(s):
        return float(np.exp(s * rng.normal()))

    bouts, runs = [bout()], []
    for name in ("tum_fr1_xyz", "7scenes_redkitchen", "synthetic"):
        for seed in range(3):
            own = speed * noisy(0.05)  # of the minute, seen by the reference work too
            bouts.append(bout())
            cpu, step = (40 * factor / own * noisy(scatter) for _ in range(2))
            runs.append(
                {
                    "sequence": name,
                    "seed": seed,
                    "figures": {"cpu_ms_per_frame": cpu, "fps": 1e3 / step},
                    "stages": {"tracking": 0.3 * step, "edges": 0.2 * step},
                    "reference": dict.fromkeys(("one_ms", "cpu_ms", "wall_ms"), 50 / own),
                    "disturbance": {"others": 0.01, "stolen": 0.0, "busy": False},
                    "error": "",
                }
            )
    return {"format": 2, "runs": runs, "machine": {"cpu": "some"}, **gather(bouts)}


def test_times_of_one_program_agree_at_any_speed_of_the_machine(rng):
    rows = [
        row
        for _ in range(60)
        for row in compare(timed_record(rng, 1.0, 0.04), timed_record(rng, float(rng.uniform(0.6, 1.6)), 0.04))
    ]
    outside = [row for row in rows if row["verdict"] != "same"]
    assert len(rows) == 60 * 13
    assert len(outside) <= 0.01 * len(rows), "a table of fifty times is to hold none by chance"


def test_a_third_more_time_is_seen_at_any_speed_of_the_machine(rng):
    for speed in (0.7, 1.0, 1.4):
        found = compare(timed_record(rng, 1.0, 0.02), timed_record(rng, speed, 0.02, factor=1.33))
        assert {row["verdict"] for row in found} == {"worse"}, speed


def test_without_the_reference_a_slower_machine_is_a_slower_program(rng):
    a, b = timed_record(rng, 1.0, 0.01), timed_record(rng, 0.6, 0.01)
    assert {row["verdict"] for row in compare(a, b)} == {"same"}
    for found in (a, b):
        found["references"] = []
    assert all(row["verdict"] == "worse" for row in compare(a, b) if row["metric"] == "cpu_ms_per_frame")


def test_other_conditions_and_a_busy_machine_are_named(rng):
    a, b = timed_record(rng, 1.0, 0.02), timed_record(rng, 0.8, 0.02)
    b["machine"], b["max_frames"] = {"cpu": "other"}, 40
    b["runs"][2]["disturbance"] = {"others": 0.4, "stolen": 0.03, "busy": True}
    text = markdown_compare(a, b)
    assert "beware: cpu was some, then other" in text and "beware: max_frames was None, then 40" in text
    assert "in the second record the machine was busy during 1 of 9 runs: other programs used up to 40%" in text
    assert "its host took up to 3%" in text


def test_a_part_that_cannot_be_measured_says_why():
    found = gather(
        [
            {"reference": {"one_ms": 1.0}, "solver": {"points": 2.0, "beside": "no gtsam"}, "depth": {"fp32": 3.0}},
            {
                "reference": {"one_ms": 1.1},
                "solver": {"points": 2.1, "beside": "no gtsam"},
                "depth": {"not measured": "x"},
            },
        ]
    )
    assert found["solver"] == {"beside": "no gtsam", "points": [2.0, 2.1]}
    assert found["depth"] == {"not measured": "x"}


def test_what_others_use_is_told_from_what_we_use(tmp_path):
    stat = tmp_path / "stat"
    stat.write_text("cpu  100 0 50 900 10 0 5 7 0 0\ncpu0 1 0 1 1\ncpu1 1 0 1 1\nintr 5\n")
    found = read_cpu_times(stat)
    assert found is not None and found.cores == 2 and found.busy > found.stolen > 0
    assert read_cpu_times(tmp_path / "none") is None
    before, after = CpuTimes(0.0, 10.0, 1.0, 3.0, 2), CpuTimes(10.0, 22.0, 1.1, 13.0, 2)
    told = disturbance(before, after)
    assert told is not None and told.others == pytest.approx(0.1) and told.stolen == pytest.approx(0.005)
    assert not told.busy and disturbance(None, after) is None


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
    assert list(sequences(BenchSettings(tmp_path / "data"), others=())) == ["fast"]
    with pytest.raises(EvaluationError, match="no such folder"):
        sequences(BenchSettings(tmp_path / "nowhere"))


@pytest.mark.parametrize("text", [None, "not json", "[]", '{"format": 0, "runs": []}'])
def test_other_files_are_no_records(text, tmp_path):
    path = tmp_path / "r.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(EvaluationError, match="r.json"):
        read_record(path)


def run_bench(*words):
    parser = argparse.ArgumentParser()
    bench.add_arguments(parser)
    return bench.main(parser.parse_args([str(w) for w in words]))


def test_compare_reads_two_results(tmp_path, capsys):
    for name, ate in (("a", 0.010), ("b", 0.020)):
        (tmp_path / f"{name}.json").write_text(json.dumps(record([ate, ate], [30, 30])))
    assert run_bench("--compare", tmp_path / "a.json", tmp_path / "b.json") == 0
    text = capsys.readouterr().out
    assert "| tum_fr1_xyz | ATE Sim(3) [m] | 0.0100 | 0.0200 | +100.0% | ±3.0% | **worse** |" in text
    assert "no reference work" in text


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(1200)
def test_synthetic_flight_is_run_and_judged(tmp_path, capsys, monkeypatch):
    monkeypatch.delenv("EDGESLAM_DATA", raising=False)
    assert run_bench("--seeds", 1, "--max-frames", 40, "--no-micro", "--out", tmp_path / "bench") == 0
    text = capsys.readouterr().out
    assert "### synthetic" in text and "edgeslam, seed 0" in text
    stored = read_record(tmp_path / "bench" / "bench.json")
    run = stored["runs"][0]
    assert run["figures"]["coverage"] > 0.5
    within = json.loads((tmp_path / "bench" / "synthetic_seed0" / "summary.json").read_text())["cpu_ms_per_frame"]
    assert run["figures"]["cpu_ms_per_frame"] > within  # start-up counts
    assert len(stored["references"]) == 2 and run["reference"]["cpu_ms"] > 0
    assert "machine: reference work" in text
