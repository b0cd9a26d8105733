"""The documentation's site: formulas, links, search, and pages that fit a phone and ask nothing of the network."""

import importlib.util
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
from browser import PROGRAM, Browser

pytest.importorskip("mkdocs", reason="the documentation's tools are not installed")

ROOT = Path(__file__).resolve().parent.parent
BUILDING = ROOT / "docs" / "building"
WITH_FORMULAS = ("fusion/scale/joint_scale.html", "losses/base.html", "losses/cycle.html")
ALL_FOUND = """new Promise((done, fail) => {
  document.querySelector('[data-md-toggle=search]').click();
  const field = document.querySelector('.md-search__input');
  const look = (left) => {  // typed again and again: the index loads after the page, in its own time
    const found = [...document.querySelectorAll('.md-search-result__link')].map(a => a.getAttribute('href'));
    if (found.length || !left) return found.length ? done(found) : fail(new Error('nothing found'));
    field.focus();
    field.value = left % 2 ? 'Schur' : 'Schur complement';
    field.dispatchEvent(new KeyboardEvent('keyup', {bubbles: true}));
    setTimeout(() => look(left - 1), 1000);
  };
  look(120);
})"""


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"docs_{name}", BUILDING / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


formulas, hooks = load("formulas"), load("hooks")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As ``make docs`` makes it; strict: a link or an anchor that leads nowhere ends it."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "-q", "-d", str(folder)]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if PROGRAM is None:
        pytest.skip("no chromium here: the pages are not opened")
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


def pages(site: Path) -> list[Path]:
    """Every guide, and of the API what has formulas."""
    guides = [page for page in site.rglob("*.html") if "api" not in page.relative_to(site).parts]
    reference = [site / "api" / "edgeslam_torch" / name for name in (*WITH_FORMULAS, "index.html", "slam.html")]
    return sorted(page for page in [*guides, *reference] if page.name != "404.html")


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("width", [360, 390, 1280])
def test_no_page_scrolls_sideways_or_logs_an_error(site: Path, browser: Browser, width: int) -> None:
    wide = {}
    for page in pages(site):
        browser.open(page, width=width, height=844, mobile=width < 700)
        wide[page.name] = browser.run("document.documentElement.scrollWidth")
    assert set(wide.values()) == {width}, {name: pixels for name, pixels in wide.items() if pixels > width}
    assert len(wide) > len(WITH_FORMULAS) + 20 and browser.errors == []


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_search_finds_without_server_and_network(site: Path, browser: Browser) -> None:
    browser.open(site / "index.html", width=1280, height=844, mobile=False)
    assert any("solver.html" in link for link in browser.run(ALL_FOUND))
    assert browser.errors == []


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_formulas_are_set_without_a_network(site: Path, browser: Browser) -> None:
    browser.open(site / "api" / "edgeslam_torch" / WITH_FORMULAS[0], width=390, height=844, mobile=True)
    sizes = browser.run("[...document.querySelectorAll('math')].map(m => m.getBoundingClientRect().height)")
    assert len(sizes) == 5 and min(sizes) > 5
    index = browser.run("document.querySelector('math msub').lastElementChild.getBoundingClientRect().height")
    letter = browser.run("document.querySelector('math msub').firstElementChild.getBoundingClientRect().height")
    assert index < letter, "a subscript is smaller than its letter"
    assert browser.run("document.querySelector('article').innerText").count("\\") == 0


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_every_module_has_a_page(site: Path) -> None:
    for module in ("slam", "losses/cycle", "models/fastdepth", "eval/metrics/trajectory_error", "train/recipe"):
        text = (site / "api" / "edgeslam_torch" / f"{module}.html").read_text(encoding="utf-8")
        assert "doc-heading" in text, f"{module}: nothing of its docstrings"


def test_formulas_keep_their_place_in_a_docstring() -> None:
    text = "Model:\n\n    .. math::\n        a_i = b,\n        \\quad c\n\n    with :math:`\\log s` known.\n"
    found = formulas.formulas_as_mathml(text)
    assert found.startswith('Model:\n\n    <span class="formula"><math ')
    assert found.count("<math") == 2 and "math:" not in found
    assert found.endswith("</math></span> known.\n")
    assert "<mi>log</mi><mspace" in found


def test_formula_at_the_start_of_a_line_does_not_split_its_paragraph() -> None:
    markdown = pytest.importorskip("markdown")
    text = formulas.formulas_as_mathml("A height above\n:math:`h + c`, which is unknown.\n")
    assert markdown.markdown(text, extensions=["md_in_html"]).count("<p>") == 1


def test_formulas_of_a_page_are_set() -> None:
    found = formulas.fenced_as_mathml("Before.\n\n```math\n\\frac{a}{b}\n```\n\n```\nmath\n```\n")
    assert found.count("<math") == 1 and "```math" not in found and "```\nmath\n```" in found


def test_example_becomes_a_section_that_is_set_as_code() -> None:
    thing = SimpleNamespace(docstring=SimpleNamespace(value="Double.\n\nExample:\n    >>> 2 * 2\n    4\n"))
    formulas.Formulas().on_object(obj=thing)
    assert "\nExamples:\n    >>>" in thing.docstring.value


def test_search_prefers_guides_and_leaves_internals_out() -> None:
    assert hooks.searched("tello.md")["boost"] > 1 > hooks.searched("decisions/01-x.md")["boost"]
    assert hooks.searched("api/edgeslam_torch/commands/run.md") == {"exclude": True}
    assert hooks.searched("api/edgeslam_torch/losses/cycle.md") == {"exclude": False}


def test_formula_that_cannot_be_set_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"does not know: \\nosuch"):
        formulas.mathml(r"\nosuch{x}", "inline")


def test_what_a_page_would_load_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text('<script async src="https://cdn.example/x.js"></script><a href="https://ok">x</a>')
    (tmp_path / "b.html").write_text('<img src="pictures/x.png"><link rel=stylesheet href=//cdn.example/x.css>')
    assert hooks.network_needs(tmp_path) == [
        "a.html: loads https://cdn.example/x.js from the network",
        "b.html: loads //cdn.example/x.css from the network",
    ]


@pytest.mark.parametrize(
    ("link", "uri", "page"),
    [
        ("docs/tello.md", "index.md", "tello.md"),
        ("docs/decisions/", "index.md", "decisions/README.md"),
        ("../README.md", "tello.md", "index.md"),
        ("../../CHANGELOG.md", "decisions/README.md", "../CHANGELOG.md"),
        ("../solver.md", "decisions/13-units.md", "../solver.md"),
        ("LICENSE", "index.md", "files/LICENSE.txt"),
        ("nosuch.md", "tello.md", "nosuch.md"),
    ],
)
def test_links_of_the_repository_become_links_of_the_site(link: str, uri: str, page: str) -> None:
    assert hooks.turned(link, uri, hooks.home(uri)) == page


def test_notebook_becomes_a_page(tmp_path: Path) -> None:
    path = tmp_path / "book.ipynb"
    path.write_text(
        '{"cells": [{"cell_type": "markdown", "source": ["# Title\\n", "words"]}, {"cell_type": "code", '
        '"source": ["1 + 1"], "outputs": [{"data": {"text/plain": ["2"]}}, {"text": ["said\\n"]}]}]}'
    )
    text = load("notebook_page").notebook_page(path)
    assert text.startswith("# Title\nwords\n\n```python\n1 + 1\n```\n\n```text\n2\n```\n\n```text\nsaid\n```\n")


def test_every_decision_record_is_in_the_index() -> None:
    records = ROOT / "docs" / "decisions"
    index = (records / "README.md").read_text(encoding="utf-8")
    missing = [path.name for path in sorted(records.glob("[0-9]*.md")) if f"({path.name})" not in index]
    assert not missing


def guides() -> list[Path]:
    """Everything that is a page, as the repository has it."""
    return [ROOT / name for name in hooks.FROM_THE_ROOT] + sorted((ROOT / "docs").rglob("*.md"))


def test_no_link_between_guides_is_broken() -> None:
    broken = []
    for guide in guides():
        text = re.sub(r"```.*?```", "", guide.read_text(encoding="utf-8"), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
            if "://" not in target and not target.startswith("mailto:") and not (guide.parent / target).exists():
                broken.append(f"{guide.relative_to(ROOT)}: {target}")
    assert broken == []


def test_no_guide_installs_the_package_from_an_index() -> None:
    for path in guides():
        found = re.findall(r"pip install[^\n]*edgeslam.torch", path.read_text(encoding="utf-8"))
        assert not found, f"{path}: the package is on no index; pip install ."
