"""A batch as a whole: what is run, kept, repeated and said; the flights' processes are tiny scripts."""

import csv
import json
import subprocess
import sys

import pytest

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import ConfigError, OutputError
from edgeslam_torch.eval.experiment.runner import Local
from edgeslam_torch.fleet.batch import run_batch
from edgeslam_torch.fleet.folder import BatchSettings
from edgeslam_torch.fleet.manifest import read_manifests
from edgeslam_torch.jobs.watched import Limits

GOOD = """
import json, pathlib, sys
job = pathlib.Path(sys.argv[1])
task = json.loads((job / 'case.json').read_text())
(pathlib.Path(task['batch']) / 'flights' / task['name']).mkdir()
figures = {'frames': 10, 'tracked': 0.9, 'ate_m': 0.02, 'scale_error': float('nan'), 'scale_source': 'depth'}
(job / 'result.json').write_text(json.dumps({'key': task['key'], 'figures': figures, 'notes': ['a <b>note</b>']}))
"""
BROKEN = "import sys; sys.exit('no image can be read')"


class Starter:
    """Starts the script given for a flight's name, and notes which."""

    def __init__(self, **scripts):
        self.scripts = scripts
        self.started = []

    def __call__(self, folder, log):
        self.started.append(folder.name)
        command = [sys.executable, "-S", "-c", self.scripts.get(folder.name, GOOD), str(folder)]
        return subprocess.Popen(command, stdout=log, stderr=log, text=True)


@pytest.fixture
def recordings(tmp_path, write_images):
    for name in ("a", "b", "c"):
        write_images(tmp_path / "recordings" / name, ["0.png"])
    return tmp_path / "recordings"


def batch(tmp_path, recordings, starter, settings=None, manifest=None, said=None):
    flights = read_manifests([str(manifest or recordings)])
    runner = Local(2, Limits(60.0), 1, starter)
    say = (lambda _: None) if said is None else said.append
    return run_batch(flights, settings or BatchSettings(SlamConfig()), tmp_path / "out", runner, say)


def states(rows):
    return {row.name: row.state for row in rows}


def test_failed_flight_is_a_row_with_its_reason_and_the_rest_is_done(tmp_path, recordings):
    rows = batch(tmp_path, recordings, Starter(b=BROKEN))
    assert states(rows) == {"a": "done", "b": "failed", "c": "done"}
    assert rows[1].reason == "no image can be read"
    assert sorted(p.name for p in (tmp_path / "out" / "flights").iterdir()) == ["a", "c"]
    table = list(csv.DictReader((tmp_path / "out" / "batch.csv").open()))
    assert [(row["name"], row["state"], row["ate_m"]) for row in table] == [
        ("a", "done", "0.02"),
        ("b", "failed", ""),
        ("c", "done", "0.02"),
    ]
    record = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert record["counts"] == {"done": 2, "failed": 1, "waiting": 0}
    assert record["medians"]["ate_m"] == 0.02
    assert record["flights"][0]["figures"]["scale_error"] is None, "JSON has no NaN"


def test_what_is_done_is_not_done_again_and_what_failed_or_changed_is(tmp_path, recordings, write_images):
    starter, said = Starter(b=BROKEN), []
    batch(tmp_path, recordings, starter)
    batch(tmp_path, recordings, starter, said=said)
    assert sorted(starter.started) == ["a", "b", "b", "c"]
    assert said[0] == "2 of 3 flights were done before"
    starter.scripts.clear()
    write_images(recordings / "a", ["1.png"])
    assert states(batch(tmp_path, recordings, starter)) == {"a": "done", "b": "done", "c": "done"}
    assert sorted(starter.started) == ["a", "a", "b", "b", "b", "c"]


def test_other_settings_start_anew_and_keep_the_older_results(tmp_path, recordings):
    starter = Starter()
    batch(tmp_path, recordings, starter)
    (tmp_path / "out" / "flights" / "a" / "of_seed_0").touch()
    batch(tmp_path, recordings, starter, BatchSettings(SlamConfig(seed=1)))
    assert len(starter.started) == 6
    assert (tmp_path / "out" / "older" / "a" / "of_seed_0").exists()
    assert not (tmp_path / "out" / "flights" / "a" / "of_seed_0").exists()


def test_interrupted_batch_leaves_a_table_of_what_is_finished(tmp_path, recordings):
    def interrupt(text):
        raise KeyboardInterrupt

    flights = read_manifests([str(recordings)])
    runner = Local(1, Limits(60.0), start=Starter())
    with pytest.raises(KeyboardInterrupt):
        run_batch(flights, BatchSettings(SlamConfig()), tmp_path / "out", runner, interrupt)
    record = json.loads((tmp_path / "out" / "batch.json").read_text())
    assert record["counts"] == {"done": 1, "failed": 0, "waiting": 2}
    assert "2 not run yet" in (tmp_path / "out" / "index.html").read_text()
    starter = Starter()
    batch(tmp_path, recordings, starter)
    assert starter.started == ["b", "c"]


def test_mistake_in_one_flights_settings_is_found_before_any_is_run(tmp_path, recordings):
    manifest = tmp_path / "flights.csv"
    manifest.write_text(f"recording,settings\n{recordings}/a,\n{recordings}/b,orb.featurs=5\n")
    starter = Starter()
    with pytest.raises(ConfigError, match=r"flights.csv, line 3: .*did you mean 'orb.features'"):
        batch(tmp_path, recordings, starter, manifest=manifest)
    assert starter.started == []


@pytest.mark.parametrize("record", [None, "precious", "[]", '{"mine": 1}'])
def test_no_batch_is_written_into_a_folder_of_others(tmp_path, recordings, record):
    files = {"batch.csv": "precious"} | ({} if record is None else {"batch.json": record})
    (tmp_path / "out").mkdir()
    for name, text in files.items():
        (tmp_path / "out" / name).write_text(text)
    with pytest.raises(OutputError):
        batch(tmp_path, recordings, starter := Starter())
    assert starter.started == []
    assert {path.name: path.read_text() for path in (tmp_path / "out").iterdir()} == files
