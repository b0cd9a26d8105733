"""The ablation's bookkeeping: which runs are made, and what the table says."""

import json

import pytest
from markdown_rows import rows

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import ConfigError, OutputError
from edgeslam_torch.eval.benchmark import benchmark
from edgeslam_torch.eval.benchmark.benchmark import BenchSettings, run_benchmark
from edgeslam_torch.eval.benchmark.rows import (
    ROWS,
    compare_networks,
    markdown_ablation,
    markdown_networks,
    run_ablation,
)
from edgeslam_torch.files.config_file import load_config


@pytest.fixture
def runs(monkeypatch, tmp_path):
    """Cases without runs: every figure follows from the settings."""
    made = []

    def run_all(tasks, runner, row, line, say):
        rows = {}
        for case, task in tasks.items():
            made.append(dict(task.case))
            words = " ".join(task.case["arguments"])
            ate = 0.010 + 0.005 * ("alignment=false" in words) + 0.02 * ("weights=none" in words) + 0.0002 * case[1]
            figures = {"ate_sim3_m": ate, "map_median_m": 0.02, "finish_ms": 500.0, "coverage": 1.0, "fps": 9.0}
            found = {"figures": figures | {"map_points": 5.0}, "stages": {"depth": 3.0}}
            rows[case] = row(case, found, "")
        return rows

    monkeypatch.setattr(benchmark, "find_recordings", lambda data, min_hz: {"kitchen": (tmp_path / "kitchen", None)})
    monkeypatch.setattr(benchmark, "run_all", run_all)
    return made


def ablation(tmp_path, *names, **settings):
    return run_ablation(BenchSettings(tmp_path, **settings), names, tmp_path, lambda line: None)


def test_every_row_is_run_with_its_settings_beside_those_it_is_compared_with(runs, tmp_path):
    record = ablation(tmp_path, "corners-no-angle", seeds=(0, 1), overrides=("seed=3",))
    assert len(runs) == 6
    assert {name for name, row in record["rows"].items() if row["runs"]} == {"default", "corners", "corners-no-angle"}
    words = [run["arguments"][-1] for run in runs[::3]]
    assert words == ["seed=3"] * 2 and "window.collinearity=relative" in runs[2]["arguments"]
    assert record == json.loads((tmp_path / "ablation.json").read_text())


def test_table_names_what_got_worse_and_leaves_the_rest_alone(runs, tmp_path):
    text = markdown_ablation(ablation(tmp_path, seeds=(0, 1), max_frames=300))
    assert "first 300 frames, seeds 0 1" in text
    lines = {name: cells for name, *cells in rows(text)}
    assert lines["default"][:2] == ["0.0101", "-"] and lines["default"][-1] == ""
    assert lines["no edge alignment"][-1] == "default: ATE Sim(3) worse"
    assert lines["no depth network"][-1] == "default: ATE Sim(3) worse"
    assert lines["no cycle loss"][-1] == "default: same"
    assert lines["literal angle (eqs. 24-25)"][-1] == "corners: same"


def test_rows_have_settings_that_exist_and_are_compared_with_rows():
    assert all(row.against in ROWS for row in ROWS.values())
    for name, row in ROWS.items():
        try:
            load_config(SlamConfig(), None, row.set)
        except ConfigError as error:
            pytest.fail(f"{name}: {error}")
        exec(row.first.partition(";")[0])  # the module is there


def test_depth_networks_are_beside_each_other(runs, tmp_path):
    records = compare_networks(BenchSettings(tmp_path, seeds=(0,)), ["default", "none"], tmp_path, lambda line: None)
    lines = rows(markdown_networks(records))[1:]
    assert [line[:4] for line in lines] == [
        ["default", "kitchen, seed 0", "0.0100", "-"],
        ["none", "kitchen, seed 0", "0.0300", "-"],
    ]
    assert [line[-1] for line in lines] == ["3.0", "3.0"]


WRITERS = {
    "bench.json": lambda settings, out: run_benchmark(settings, out, print),
    "ablation.json": lambda settings, out: run_ablation(settings, (), out, print),
    "cases/mine.txt": lambda settings, out: compare_networks(settings, ["none"], out, print),
}


@pytest.mark.parametrize("name", WRITERS)
def test_results_of_others_are_not_replaced_and_own_ones_are(runs, tmp_path, name):
    settings, theirs, ours = BenchSettings(tmp_path, (0,), ("kitchen",)), tmp_path / "theirs", tmp_path / "ours"
    (theirs / name).parent.mkdir(parents=True)
    (theirs / name).write_text("precious")
    with pytest.raises(OutputError):
        WRITERS[name](settings, theirs)
    assert (theirs / name).read_text() == "precious" and runs == []
    ours.mkdir()
    for _ in range(2):
        WRITERS[name](settings, ours)
