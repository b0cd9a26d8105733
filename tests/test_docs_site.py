"""The documentation's site: formulas, links, search, reference, and pages that fit a phone and need no network."""

import ast
import importlib
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from browser import PROGRAM, Browser

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.files.config_file import to_toml

pytest.importorskip("mkdocs", reason="the documentation's tools are not installed")

ROOT = Path(__file__).resolve().parent.parent
BUILDING = ROOT / "docs" / "building"


def load(name):
    sys.path.insert(0, str(BUILDING))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(BUILDING))


formulas, hooks, reference = load("formulas"), load("hooks"), load("reference")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """What ``make docs`` made, if nothing has changed since; strict: a link or an anchor that leads nowhere ends it."""
    made = ROOT / "site" / "search" / "search_index.js"  # written last
    folders = (ROOT / name for name in ("docs", "examples", "edgeslam_torch", "models", "losses", "train", "eval"))
    sources = [path for folder in folders for path in folder.rglob("*.*") if "__pycache__" not in path.parts]
    sources += [ROOT / "mkdocs.yml", *ROOT.glob("*.md")]
    if made.is_file() and made.stat().st_mtime > max(path.stat().st_mtime for path in sources):
        return ROOT / "site"
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "-q", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    if PROGRAM is None:
        pytest.skip("no chromium here: the pages are not opened")
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


def pages(site):
    return sorted(page for page in site.rglob("*.html") if page.name != "404.html")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("width", [360, 1280])
def test_no_page_scrolls_sideways_or_logs_an_error(site, browser, width):
    wide = {}
    for page in pages(site):
        browser.open(page, width=width, height=844, mobile=width < 700)
        wide[page.name] = browser.run("document.documentElement.scrollWidth")
    assert set(wide.values()) == {width}, {name: pixels for name, pixels in wide.items() if pixels > width}
    assert len(wide) > 20 and browser.errors == []


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_formulas_are_set_without_a_network(site, browser):
    page = max(pages(site), key=lambda path: path.read_text(encoding="utf-8").count("<math"))
    browser.open(page, width=390, height=844, mobile=True)
    sizes = browser.run("[...document.querySelectorAll('math')].map(m => m.getBoundingClientRect().height)")
    assert len(sizes) >= 5 and min(sizes) > 5
    size = "parseFloat(getComputedStyle(document.querySelector('math msub').%sElementChild).fontSize)"
    assert browser.run(size % "last") < browser.run(size % "first"), "a subscript is smaller than its letter"
    assert browser.run("document.querySelector('article').innerText").count("\\") == 0


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_reference_has_what_guides_and_examples_import(site):
    shown = {
        anchor.rpartition(".")[2]
        for page in (site / "reference" / "api").glob("*.html")
        for anchor in re.findall(r'id="(edgeslam_torch[\w.]+)"', page.read_text(encoding="utf-8"))
    }
    assert imported_names() - shown == set()


def imported_names():
    """Names of the package that code in guides, README and examples imports."""
    guides_ = [ROOT / "README.md", *(ROOT / "docs").glob("start/*.md"), *(ROOT / "docs").glob("guides/*.md")]
    code = [path.read_text(encoding="utf-8") for path in (ROOT / "examples").glob("*.py")]
    for guide in guides_:
        code += re.findall(r"^```python\n(.*?)^```$", guide.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    found = [node for text in code for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
    return {name.name for node in found if (node.module or "").startswith("edgeslam_torch") for name in node.names}


@pytest.mark.slow
def test_every_setting_has_its_default_and_its_reason():
    rows = re.findall(r"^\| `(\w+)` \| `([^`]+)`[^|]* \| (.+) \|$", reference.settings_page(), re.MULTILINE)
    config = tomllib.loads(to_toml(SlamConfig()))
    flat = [
        (k, v) for name, part in config.items() for k, v in (part.items() if isinstance(part, dict) else [(name, part)])
    ]
    assert {key for key, _ in flat} <= {key for key, _, _ in rows}
    assert all(len(reason) > 10 for _, _, reason in rows)
    defaults = {(key, shown) for key, shown, _ in rows}
    assert {(key, json.dumps(value)) for key, value in flat if isinstance(value, (bool, int, str))} <= defaults


def test_formulas_keep_their_place_in_a_docstring():
    text = "Model:\n\n    .. math::\n        a_i = b,\n        \\quad c\n\n    with :math:`\\log s` known.\n"
    found = formulas.formulas_as_mathml(text)
    assert found.startswith('Model:\n\n    <span class="formula"><math ')
    assert found.count("<math") == 2 and "math:" not in found
    assert found.endswith("</math></span> known.\n")
    assert "<mi>log</mi><mspace" in found


def test_formula_that_cannot_be_set_is_an_error():
    with pytest.raises(ValueError, match=r"does not know: \\nosuch"):
        formulas.mathml(r"\nosuch{x}", "inline")


def test_what_a_page_would_load_is_found(tmp_path):
    (tmp_path / "a.html").write_text('<script async src="https://cdn.example/x.js"></script><a href="https://ok">x</a>')
    (tmp_path / "b.html").write_text('<img src="pictures/x.png"><link rel=stylesheet href=//cdn.example/x.css>')
    assert hooks.network_needs(tmp_path) == [
        "a.html: loads https://cdn.example/x.js from the network",
        "b.html: loads //cdn.example/x.css from the network",
    ]
