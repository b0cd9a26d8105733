"""``edgeslam judge`` from the command line, on a recording of a few small images."""

import json
from pathlib import Path

import pytest
from rendered import panels

from edgeslam_torch import cli

RELEASE = Path(__file__).parents[2] / "docs" / "results" / "0.3.json"


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with one recording of 30 images."""
    return panels().first(30).write(tmp_path_factory.mktemp("data") / "stairs").parent


@pytest.mark.slow
def test_table_is_printed_written_and_compared(data, tmp_path, capsys):
    out = tmp_path / "out"
    command = ["judge", str(data), "--jobs", "1", "--first-seed", "3", "--set", "depth.weights=none"]
    assert cli.main([*command, "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "| stairs |" in printed and "| frames |" in printed
    (row,) = json.loads((out / "judge.json").read_text())["rows"]
    assert (row["cell"], row["seed"]) == ("stairs", 3) and row["figures"]["frames"] == 30
    assert (out / "judge.md").read_text() in printed
    before = {path: path.stat().st_mtime_ns for path in out.glob("cells/**/trajectory.txt")}
    assert cli.main([*command, "--out", str(out), "--against", str(out)]) == 0
    assert "worse: nothing" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in before} == before != {}, "what is done is not run again"


@pytest.mark.parametrize(
    "arguments",
    ["data --only desk*", "data --against nowhere", "data --thresholds nowhere.toml",
     "data --release 0.3.json", "data --release 0.3.json --only stairs", "data --set base", ""],
)  # fmt: skip
def test_mistakes_are_one_line(data, tmp_path, capsys, monkeypatch, arguments):
    monkeypatch.delenv("EDGESLAM_DATA", raising=False)
    words = arguments.replace("data", str(data), 1).split()
    assert cli.main(["judge", "--out", str(tmp_path / "out"), *words]) == 1
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("content", ["precious", '{"version": "1"}'])
def test_a_release_replaces_nothing_but_a_release(data, tmp_path, capsys, monkeypatch, content):
    """Of its own results it comes as far as the runs."""

    def words(path):
        assert cli.main(["judge", str(data), "--out", str(tmp_path / "out"), "--release", str(path)]) == 1
        return capsys.readouterr().err

    path = tmp_path / "0.3.json"
    path.write_text(content)
    assert str(path) in words(path)
    assert path.read_text() == content
    assert "missing" in words(RELEASE), "stairs are not all that a release needs"
    assert str(data / "stairs") in words(data / "stairs" / "new.mcap")
