"""The ablation's bookkeeping: which rows share a flight, what is repeated, and what the table says."""

import json
from pathlib import Path
from types import SimpleNamespace

import pytest

from edgeslam_torch.eval.benchmark import ablation
from edgeslam_torch.eval.benchmark.ablation import ROWS, AblationSettings, markdown_ablation, run_ablation
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.mapping import prior_anchors


@pytest.fixture
def flights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list:
    """Flights without flying: every row's figures follow from its settings."""
    made: list = []

    def fly(folder, config, max_frames):
        made.append((folder.name, config))
        return SimpleNamespace(config=config)

    def finish(flight, window, dataset):
        ate = 0.010 + 0.005 * (not window.alignment) + 0.0001 * flight.config.seed
        ate += 0.002 * (window.reprojection == "literal") + 0.02 * (flight.config.depth.weights == "none")
        return {"ate_sim3_m": ate, "map_median_m": 0.02, "scale_error_abs": None, "finish_ms": 500.0}

    monkeypatch.setattr(ablation, "find_sequences", lambda data, min_hz: {"kitchen": tmp_path / "kitchen"})
    monkeypatch.setattr(ablation, "open_dataset", lambda folder: None)
    monkeypatch.setattr(ablation, "_fly", fly)
    monkeypatch.setattr(ablation, "_finish", finish)
    return made


def test_rows_that_differ_in_the_last_refinement_alone_share_a_flight(flights, tmp_path):
    record = run_ablation(AblationSettings(tmp_path, seeds=(0, 1)), tmp_path / "out", lambda line: None)
    assert len(flights) == 2 * 16  # all rows but those of the last refinement, which share the default's
    assert len({config for _, config in flights}) == 2 * 15  # the network's own sigma is no setting
    assert all(len(row["runs"]) == 2 for row in record["rows"].values())
    assert record == json.loads((tmp_path / "out" / "ablation.json").read_text())


def test_runs_that_are_there_are_not_repeated_and_other_settings_are_refused(flights, tmp_path):
    settings = AblationSettings(tmp_path, seeds=(0,), rows=("points",))
    run_ablation(settings, tmp_path / "out", lambda line: None)
    run_ablation(settings, tmp_path / "out", lambda line: None)
    assert len(flights) == 1
    run_ablation(AblationSettings(tmp_path, seeds=(0,), rows=("no-cycle",)), tmp_path / "out", lambda line: None)
    assert len(flights) == 2
    with pytest.raises(EvaluationError, match="other settings; give another --out"):
        run_ablation(AblationSettings(tmp_path, seeds=(0, 1)), tmp_path / "out", lambda line: None)


def test_table_names_what_got_worse_and_leaves_the_rest_alone(flights, tmp_path):
    settings = AblationSettings(tmp_path, seeds=(0, 1), max_frames=300)
    text = markdown_ablation(run_ablation(settings, tmp_path / "out", lambda line: None))
    assert "first 300 frames, seeds 0 1" in text
    lines = {line.split("|")[1].strip(): line for line in text.splitlines() if line.startswith("| ")}
    assert "| 10.1 | - | 20.0 | - | - | - | - | - | 500 |  |" in lines["default"]
    assert "default: ATE worse" in lines["no edge alignment"]
    assert "default: ATE worse" in lines["no depth network"]
    assert "default: same" in lines["no cycle loss"]
    assert "corners: same" in lines["literal angle (eqs. 24-25)"]


def test_rows_can_be_told_apart_and_are_compared_with_rows():
    names = [row.name for row in ROWS]
    assert len(set(names)) == len(names)
    assert all(row.against in names for row in ROWS)


@pytest.mark.parametrize(
    ("change", "message"), [({"rows": ("nonsense",)}, "no row"), ({"sequences": ("x",)}, "no seq")]
)
def test_unknown_names_are_refused(flights, tmp_path, change, message):
    with pytest.raises(EvaluationError, match=message):
        run_ablation(AblationSettings(tmp_path, **change), tmp_path / "out", lambda line: None)


def test_the_network_is_believed_for_one_flight_alone():
    bound = prior_anchors.MIN_SIGMA_LOG
    with ablation._network_believed(True):
        assert prior_anchors.MIN_SIGMA_LOG == 0.0
    assert bound == prior_anchors.MIN_SIGMA_LOG > 0.0
    with ablation._network_believed(False):
        assert bound == prior_anchors.MIN_SIGMA_LOG
