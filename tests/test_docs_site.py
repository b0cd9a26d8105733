"""The documentation's site: formulas, links and pages that fit a phone and ask nothing of the network."""

import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from browser import PROGRAM, Browser

pytest.importorskip("pdoc", reason="the documentation's tools are not installed")

BUILD = Path(__file__).resolve().parent.parent / "docs" / "build.py"
WITH_FORMULAS = ("edgeslam_torch.fusion.scale.joint_scale", "edgeslam_torch.losses.base", "edgeslam_torch.losses.cycle")


def load_build() -> ModuleType:
    spec = importlib.util.spec_from_file_location("docs_build", BUILD)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


build = load_build()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build.write_guides(folder)
    build.write_reference(folder / "api", WITH_FORMULAS)
    return folder


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    if PROGRAM is None:
        pytest.skip("no chromium here: the pages are not opened")
    with Browser(tmp_path_factory.mktemp("profile")) as started:
        yield started


def pages(site: Path) -> list[Path]:
    """All but the page that sends the reader on to the first module."""
    return sorted(page for page in site.rglob("*.html") if page != site / "api" / "index.html")


@pytest.mark.slow
@pytest.mark.parametrize("width", [360, 390, 1280])
def test_no_page_scrolls_sideways(site: Path, browser: Browser, width: int) -> None:
    wide = {}
    for page in pages(site):
        browser.open(page, width=width, height=844, mobile=width < 700)
        wide[page.name] = browser.run("document.documentElement.scrollWidth")
    assert set(wide.values()) == {width}, {name: pixels for name, pixels in wide.items() if pixels > width}
    assert len(wide) > len(WITH_FORMULAS) + 10 and browser.errors == []


@pytest.mark.slow
def test_links_between_guides_have_room_between_them(site: Path, browser: Browser) -> None:
    browser.open(site / "index.html", width=390, height=844, mobile=True)
    assert " ".join(browser.run("document.querySelector('nav').innerText").split()).startswith("Readme Contributing ")
    assert browser.run("document.querySelectorAll('nav a[aria-current]').length") == 1


def test_formulas_are_set_without_a_network(site: Path, browser: Browser) -> None:
    browser.open(
        site / "api" / "edgeslam_torch" / "fusion" / "scale" / "joint_scale.html", width=390, height=844, mobile=True
    )
    sizes = browser.run("[...document.querySelectorAll('math')].map(m => m.getBoundingClientRect().height)")
    assert len(sizes) == 5 and min(sizes) > 5
    index = browser.run("document.querySelector('math msub').lastElementChild.getBoundingClientRect().height")
    letter = browser.run("document.querySelector('math msub').firstElementChild.getBoundingClientRect().height")
    assert index < letter, "a subscript is smaller than its letter"
    assert browser.run("document.body.innerText").count("\\") == 0
    assert build.network_needs(site) == []


def test_formulas_keep_their_place_in_a_docstring() -> None:
    text = "Model:\n\n    .. math::\n        a_i = b,\n        \\quad c\n\n    with :math:`\\log s` known.\n"
    found = build.formulas_as_mathml(text)
    assert found.startswith('Model:\n\n    <span class="formula"><math ')
    assert found.count("<math") == 2 and "math:" not in found
    assert found.endswith("</math> known.\n")
    assert "<mi>log</mi><mspace" in found


def test_formula_that_cannot_be_set_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"does not know: \\nosuch"):
        build.mathml(r"\nosuch{x}", "inline")


def test_what_a_page_would_load_is_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text('<script async src="https://cdn.example/x.js"></script><a href="https://ok">x</a>')
    (tmp_path / "b.html").write_text('<img src="pictures/x.png"><link rel=stylesheet href=//cdn.example/x.css>')
    assert build.network_needs(tmp_path) == [
        "a.html: loads https://cdn.example/x.js from the network",
        "b.html: loads //cdn.example/x.css from the network",
    ]


def test_every_decision_record_is_in_the_index() -> None:
    records = BUILD.parent / "decisions"
    index = (records / "README.md").read_text(encoding="utf-8")
    missing = [path.name for path in sorted(records.glob("0*.md")) if f"({path.name})" not in index]
    assert not missing


def test_no_guide_installs_the_package_from_an_index() -> None:
    root = BUILD.parent.parent
    guides = [root / name for name in build.GUIDES] + sorted((root / "docs").rglob("*.md"))
    for path in guides:
        found = re.findall(r"pip install[^\n]*edgeslam.torch", path.read_text(encoding="utf-8"))
        assert not found, f"{path}: the package is on no index; pip install ."
