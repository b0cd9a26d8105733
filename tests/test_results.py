"""Documents quote one release: what stands in them is what its record gives."""

import importlib.util
import re
from pathlib import Path

import pytest
from rendered import panels

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.judge import release
from edgeslam_torch.eval.judge.release import FIGURES, RUNS, release_record

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"


def load(path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


results_pages = load(ROOT / "docs" / "building" / "results_pages.py")


@pytest.mark.parametrize("page", results_pages.PAGES, ids=lambda page: page.name)
def test_page_is_what_the_release_gives(page):
    text = page.read_text(encoding="utf-8")
    again = results_pages.rewritten(text, results_pages.current())
    assert text == again, f"run: python {Path(results_pages.__file__).relative_to(ROOT)}"
    assert "<!-- results:" in text


def test_documents_show_all_commands_of_a_release_and_no_others() -> None:
    pages = [README, *(ROOT / "docs").rglob("*.md")]
    shown = [line for page in pages for line in re.findall(r"^ *\$ (edgeslam .+)$", page.read_text("utf-8"), re.M)]
    assert set(shown) == set(release.COMMANDS.values())


ELSEWHERE = re.compile(r"<!-- results: .*?<!-- end -->|^ *```.*?^ *```|`[^`]*`|\]\([^)]*\)", re.DOTALL | re.MULTILINE)
"""Generated blocks, code and links."""


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "decisions").glob("[0-9]*.md")), ids=lambda page: page.stem)
def test_figures_of_a_decision_are_generated_or_part_of_what_was_decided(page):
    text = page.read_text(encoding="utf-8").partition("\n")[2]
    text = re.sub(
        r"\*\*Decision\.\*\*.*?(?=\n\*\*)|\[decision \d+|eqs?\. \d+((, | to | and )\d+)*", "", text, flags=re.DOTALL
    )
    assert re.findall(r"(?<![\w-])\.?\d[\d.]*(?![\w-])", ELSEWHERE.sub("", text)) == []


@pytest.mark.parametrize(
    "page", [README, *sorted((ROOT / "docs" / "results").glob("*.md"))], ids=lambda page: page.name
)
def test_decimals_of_results_are_generated(page):
    assert re.findall(r"\b\d*\.\d+ ?(?:m|cm|mm|%|ms|MB|s)\b", ELSEWHERE.sub("", page.read_text(encoding="utf-8"))) == []


def test_readme_s_python_runs(tmp_path, monkeypatch):
    panels().first(6).write(tmp_path / "recordings" / "tum_fr1_xyz")
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    names = {}
    exec(code, names)
    assert names["T_w_c"].shape == (6, 4, 4) and names["points"].shape[1] == 3


def rows(**changes):
    """Every run of a release; figures are the seed."""
    figures = [dict.fromkeys((*FIGURES, "took_s"), float(seed)) for seed in range(max(RUNS.values()))]
    return [
        {"cell": name, "seed": seed, "figures": figures[seed], "error": ""} | changes
        for name, seeds in RUNS.items()
        for seed in range(seeds)
    ]


def test_release_holds_median_and_range_of_every_figure():
    found = release_record(rows(), "abc", {})
    assert found["commit"] == "abc" and set(found["runs"]) == set(RUNS)
    assert found["runs"]["tum_fr1_xyz"]["ate_m"] == [1.0, 0.0, 2.0]
    assert found["runs"]["hololens_a/perturbed"]["seeds"] == 8
    assert found["runs"]["hololens_a/perturbed"]["cpu_orb"] == [3.5, 0.0, 7.0]


@pytest.mark.parametrize(
    ("commit", "broken", "words"),
    [
        ("abc+123", rows(), "uncommitted"),
        ("abc", rows(error="killed"), "runs failed"),
        ("abc", rows()[1:], "2 of 3 runs"),
    ],
)
def test_release_that_nobody_can_repeat_is_refused(commit, broken, words):
    with pytest.raises(EvaluationError, match=re.escape(words)):
        release_record(broken, commit, {})
