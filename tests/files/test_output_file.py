"""No command replaces a file unasked, and none what it reads."""

import argparse
import os
from contextlib import nullcontext
from pathlib import Path

import pytest

from edgeslam_torch.cli import main
from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.output_file import add_overwrite, check_new, check_outputs, output_file
from edgeslam_torch.writers.run_writer import OUTPUTS


@pytest.fixture
def parser():
    parser = argparse.ArgumentParser()
    parser.add_argument("inputs", nargs="+")
    parser.add_argument("--json", type=output_file)
    parser.add_argument("--markdown", "-m", type=output_file)
    add_overwrite(parser)
    return parser


def _check(parser, *words):
    check_outputs(parser, parser.parse_args([str(word) for word in words]))


@pytest.mark.parametrize(
    "name",
    [*OUTPUTS, "rgb.txt", "groundtruth.txt", "telemetry.csv", "mine.json", "rgb/1.png", "mav0/cam0/data/7.JPG"]
    + ["flight.mp4", "bag_0.mcap", "bag_0.db3"],
)
def test_no_file_of_a_folder_that_is_read_is_replaced(parser, tmp_path, name):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).touch()
    free = {"mine.json", "report.html", "config.toml"}  # not read
    with nullcontext() if name in free else pytest.raises(OutputError, match="reads"):
        _check(parser, tmp_path, "--json", tmp_path / name, "--overwrite")


@pytest.mark.parametrize(
    ("name", "is_free"),
    [("new.mcap", False), ("new.bag", False), ("rgb.txt", False), ("7.png", False)]
    + [("new.json", True), ("plots/7.png", True), ("made.yaml", True)],
)
def test_nothing_is_added_to_a_recording_that_is_read(parser, tmp_path, name, is_free):
    """It would be read in place of the pictures, or as one of them."""
    (tmp_path / "0.png").touch()
    with nullcontext() if is_free else pytest.raises(OutputError):
        _check(parser, tmp_path, "--json", tmp_path / name, "--overwrite")


@pytest.mark.parametrize("mark", ["rgb.txt", "mav0"])
def test_nothing_is_added_to_a_recording_that_is_not_read(parser, tmp_path, mark):
    (tmp_path / mark).mkdir()
    with pytest.raises(OutputError):
        _check(parser, "in", "--json", tmp_path / "new.mcap")
    _check(parser, "in", "--json", tmp_path / "new.json")


@pytest.mark.parametrize("spelling", ["same", "relative", "symlink", "hard link"])
def test_what_is_read_is_never_replaced(parser, tmp_path, monkeypatch, spelling):
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "truth.txt"
    path.write_text("truth")
    if spelling == "symlink":
        (tmp_path / "other").symlink_to(path)
    if spelling == "hard link":
        os.link(path, tmp_path / "other")
    other = {"same": path, "relative": Path("truth.txt")}.get(spelling, tmp_path / "other")
    with pytest.raises(OutputError, match="reads"):
        _check(parser, "first", path, "--json", other, "--overwrite")


@pytest.mark.parametrize("name", ["groundtruth.txt", "rgb/1.png"])
def test_the_recording_of_a_run_is_read_with_it(parser, tmp_path, name):
    run, path = tmp_path / "runs" / "a", tmp_path / "flight" / name
    for folder in (run, path.parent):
        folder.mkdir(parents=True)
    (run / "summary.json").write_text('{"source": {"path": "../../flight"}}')
    path.touch()
    with pytest.raises(OutputError, match="reads"):
        _check(parser, run, "--json", path, "--overwrite")


def test_two_results_need_two_files_and_no_folder(parser, tmp_path):
    with pytest.raises(OutputError, match="twice"):
        _check(parser, "in", "--json", tmp_path / "a", "-m", tmp_path / "." / "a")
    with pytest.raises(OutputError, match="folder"):
        check_new(tmp_path, overwrite=True)


@pytest.mark.parametrize(
    "command",
    [
        "run IN --save-mcap FILE",
        "run IN --save-rrd FILE",
        "run IN --save-atlas FILE",
        "eval IN -g IN --json FILE",
        "eval IN -g IN --markdown FILE",
        "eval IN -g IN --json FILE --overwrite",
        "compare IN IN -g IN --json FILE",
        "calibrate IN --out FILE",
        "export --out FILE",
        "report IN IN --out FILE",
        "bench --json FILE",
        "ablation --markdown FILE",
        "view IN --save-rrd FILE",
        "weights convert IN --out FILE",
        "weights download near --out FILE",
    ],
)
def test_commands_leave_what_is_there(command, tmp_path, capsys):
    path = tmp_path / "truth.txt"
    path.write_text("".join(f"{i / 10:.1f} {i / 7:.4f} {(i % 5) / 3:.4f} 0 0 0 0 1\n" for i in range(60)))
    before = path.read_bytes()
    words = [{"IN": str(path), "FILE": str(path)}.get(word, word) for word in command.split()]
    assert main(words) == 1
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["truth.txt"]
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("edgeslam: error: ") and str(path) in last
