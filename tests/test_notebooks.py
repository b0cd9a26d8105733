"""The notebooks run from an empty kernel to the end, and show something."""

import re
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed")

NOTEBOOKS = sorted((Path(__file__).resolve().parent.parent / "examples" / "notebooks").glob("*.ipynb"))


def outputs(book):
    """What the cells print, and how many pictures they draw."""
    found = [output for cell in book.cells if cell.cell_type == "code" for output in cell.outputs]
    said = "".join(o.get("text", "") for o in found if o.get("name") != "stderr")
    return said, sum("image/png" in o.get("data", {}) for o in found)


def run(path):
    """Execute a copy; its text."""
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    book = nbformat.read(path, as_version=4)
    nbclient.NotebookClient(book, timeout=280, resources={"metadata": {"path": str(path.parent)}}).execute()
    text, pictures = outputs(book)
    assert pictures == 1
    return text


def numbers(text, pattern):
    """Numbers that a sentence holds."""
    match = re.search(pattern, text)
    assert match, text
    return [float(number) for number in match.groups()]


def test_every_notebook_was_saved_with_its_output():
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:
        text, pictures = outputs(nbformat.read(path, as_version=4))
        assert text and pictures == 1, f"{path.name}: make notebooks"
        assert path.stat().st_size < 300_000
        assert "/home/" not in path.read_text(encoding="utf-8") and "/tmp/" not in path.read_text(encoding="utf-8")


@pytest.mark.slow
def test_slam_in_ten_lines_is_right_to_centimetres():
    (off_cm,) = numbers(run(NOTEBOOKS[0]), r"off by ([\d.]+) cm")
    assert off_cm < 10


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_fine_tuning_lowers_the_error():
    before, after = numbers(run(NOTEBOOKS[1]), r"median scaling: ([\d.]+) before, ([\d.]+) after")
    assert after < 0.85 * before


@pytest.mark.slow
@pytest.mark.alone
def test_emulator_is_flown():
    text = run(NOTEBOOKS[2])
    assert "reports and pictures came" in text and re.search(r"battery \d+ %", text)
