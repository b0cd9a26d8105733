"""Bars, table and comparison on records written by hand."""

import pytest
from markdown_rows import row as cells_of

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.figures import compared
from edgeslam_torch.eval.judge.score import COLUMNS
from edgeslam_torch.eval.judge.table import markdown, read_thresholds, verdicts


def row(cell, seed=0, error="", **figures):
    return {"cell": cell, "base": cell.split("/")[0], "seed": seed, "figures": figures, "notes": [], "error": error}


def record(*rows, commit="abc"):
    return {"format": 1, "commit": commit, "made": "now", "overrides": [], "max_frames": None, "rows": list(rows)}


@pytest.fixture
def thresholds(tmp_path):
    (tmp_path / "thresholds.toml").write_text(
        '[[threshold]]\ncells = ["desk"]\nate_m = { at_most = 0.02 }\nsupported_end = { at_least = 1.0 }\n'
        '[[threshold]]\ncells = ["desk/*"]\nate_m = { at_most_times_base = 3.0 }\n'
        '[[threshold]]\ncells = ["flight/*"]\nate_percent = { at_most = 0.5, share = 0.75 }\n'
    )
    return read_thresholds(tmp_path / "thresholds.toml")


def test_every_seed_must_be_within_the_limit(thresholds):
    rows = [row("desk", 0, ate_m=0.01, supported_end=1.0), row("desk", 1, ate_m=0.03, supported_end=1.0)]
    ate, supported = verdicts(rows, thresholds, "desk")
    assert not ate.ok and (ate.passed, ate.runs, ate.worst) == (1, 2, 0.03)
    assert supported.ok
    assert [v.ok for v in verdicts([row("desk", ate_m=0.01)], thresholds, "desk")] == [True, False], "none is no pass"


def test_variant_is_compared_with_the_median_of_its_base(thresholds):
    base = [row("desk", seed, ate_m=ate) for seed, ate in enumerate((0.01, 0.02, 0.05))]
    near, far = row("desk/half_rate", ate_m=0.06), row("desk/half_size", ate_m=0.061)
    assert verdicts([*base, near], thresholds, "desk/half_rate")[0].ok
    assert not verdicts([*base, far], thresholds, "desk/half_size")[0].ok
    assert verdicts([far], thresholds, "desk/half_size") == [], "without its base it cannot be judged"


def test_share_of_all_runs_is_enough_where_a_bar_says_so(thresholds):
    rows = [row(f"flight/{k}", seed, ate_percent=p) for k, seed, p in
            (("room", 0, 0.4), ("room", 1, 0.6), ("hall", 0, 0.1), ("hall", 1, 0.2))]  # fmt: skip
    (verdict_,) = verdicts(rows, thresholds)
    assert verdict_.ok and verdict_.passed == 3
    rows[0]["figures"]["ate_percent"] = 0.7
    assert not verdicts(rows, thresholds)[0].ok
    assert verdicts(rows, thresholds, "flight/room") == []


def test_bar_that_says_nothing_is_refused(tmp_path):
    (tmp_path / "thresholds.toml").write_text('[[threshold]]\ncells = ["a"]\nate_m = { below = 1 }\n')
    with pytest.raises(EvaluationError, match="ate_m needs cells, and one of at_least"):
        read_thresholds(tmp_path / "thresholds.toml")


def test_table_shows_medians_bars_and_failures(thresholds):
    text = markdown(
        record(
            row("desk", 0, ate_m=0.01, supported_end=1.0, map_median_m=0.012),
            row("desk", 1, ate_m=0.03, supported_end=0.5),
            row("desk/half_rate", error="killed by signal 9"),
            row("wood", ate_m=0.5),
        ),
        thresholds,
    )
    desk = cells_of(text, "desk")
    assert desk["ATE"] == "0.0200 [0.0100 0.0300]"
    assert desk["end %"] == "75.0"
    assert desk["median cm"] == "1.20"
    assert desk["thresholds"] == "FAIL 2 of 2"
    assert "- desk: ate_m <= 0.02 (1/2, worst 0.03); supported_end >= 1 (1/2, worst 0.5)" in text
    assert cells_of(text, "desk/half_rate")["thresholds"] == "FAIL 1 of 1 runs"
    assert "- desk/half_rate seed 0: no result: killed by signal 9" in text
    assert cells_of(text, "wood")["thresholds"] == "-"
    assert "0 of 2 cells with thresholds pass" in text


def test_records_are_shown_side_by_side():
    before = record(row("gone", ate_m=0.01), row("desk", ate_m=0.01, losses=0.0), row("old", ate_m=0.1), commit="one")
    crashed = row("gone", error="crashed")
    after = record(crashed, row("desk", ate_m=0.02, losses=0.0), row("new", ate_m=0.1), commit="two")
    text = compared(before, after, "rows", "cell", COLUMNS)
    assert "one -> two" in text
    assert cells_of(text, "desk")["ATE"] == "0.0100 -> 0.0200 x2.00 !"
    assert cells_of(text, "desk")["lost"] == "0 -> 0"
    assert "only in one of the two: new, old" in text
    assert cells_of(text, "gone")["ATE"] == "0.0100 -> - !"
    assert "worse: gone ATE (none any more), desk ATE x2.00" in text
