"""The report in a real headless browser: no error, something drawn, every control works, no network."""

import json
from pathlib import Path

import pytest
from browser import PROGRAM, Browser

from edgeslam_torch.eval.report.page import write_report

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="no chromium here: the report page is not opened")

PROBE = Path(__file__).with_name("report_probe.js")


@pytest.fixture(scope="module")
def page(tmp_path_factory, run_folder):
    folder = tmp_path_factory.mktemp("report") / "run"
    truth = run_folder(folder, points=20_000)
    return write_report(folder, truth)


@pytest.fixture
def browser(tmp_path):
    with Browser(tmp_path / "profile") as started:
        yield started


@pytest.mark.slow
def test_every_control_of_the_page_works(page, browser):
    browser.open(page)
    found = browser.run(PROBE.read_text(encoding="utf-8"))
    assert found["ready"] == "yes"
    assert browser.errors == []
    assert found["requests"] == [], "the page must not ask the network for anything"
    assert not found["wide"], "the page scrolls sideways"
    assert found["flatColours"] > 50
    assert {"s-error", "s-status", "s-scale", "s-stages", "s-keyframes"} <= set(found["sections"])
    assert found["charts"] >= 5
    if found.get("nogl"):
        pytest.skip("this browser has no WebGL 2 (no software renderer)")
    assert found["start"]["drawn"] > 2000, "the canvas is blank"
    assert 500 < found["sparse"] < found["start"]["drawn"], "a share of the points is a thinner picture of the same map"
    assert found["moving"], "while it is turned it may be drawn thinner"
    assert set(found["toggles"]) == {
        f"show-{n}" for n in ("edges", "anchors", "trajectory", "cameras", "truth", "grid")
    }
    for name, toggle in found["toggles"].items():
        assert toggle["changed"], f"{name} changes nothing"
        assert toggle["restored"], f"{name} does not come back"
    assert len(set(found["colours"].values())) == 4
    assert len({v["sum"] for v in found["views"].values()}) == 4
    assert all(v["drawn"] > 500 for v in found["views"].values())
    assert found["turned"] and found["zoomed"] and found["pinched"] and found["sigmaHides"]

    chunks = found["chunks"]
    assert len(chunks) == 7 and chunks[0][0] == 0 and chunks[-1][1] == found["paced"]["total"]
    assert all(a[1] == b[0] for a, b in zip(chunks, chunks[1:], strict=False)), "every point once"
    assert found["refined"] == found["start"]["sum"], "drawn bit by bit it is the same picture as drawn at once"
    slow, fast = found["paced"]["slow"], found["paced"]["fast"]
    assert max(slow["gaps"][3:]) < 50, "three frames on, no frame of a slow machine is longer than 50 ms"
    assert fast["points"] >= found["paced"]["total"], "a fast one draws everything while it is turned"


@pytest.mark.slow
def test_page_fits_a_phone(page, browser):
    browser.open(page, width=360, height=780, ratio=3.0, mobile=True)
    found = browser.run(PROBE.read_text(encoding="utf-8"))
    assert browser.errors == []
    assert not found["wide"]


@pytest.fixture(scope="module")
def worst_page(tmp_path_factory, run_folder):
    """Every text as long as it can be and without a space, a recording of hours that ends at a tick of the charts."""
    folder, long = tmp_path_factory.mktemp("worst") / "run", "unbroken_" * 30
    truth = run_folder(folder, points=500, rate_hz=199 / 12000)
    table = (folder / "status.csv").read_text().replace("features_ms", f"{long}ms").replace("few matches", long)
    (folder / "status.csv").write_text(table)
    summary = json.loads((folder / "summary.json").read_text())
    summary |= {"source": f"nowhere/{long}", "command": long, long: long, "warnings": [long]}
    (folder / "summary.json").write_text(json.dumps(summary))
    (folder / "config.toml").write_text(long)
    return write_report(folder, truth)


@pytest.mark.slow
@pytest.mark.parametrize("width", [320, 390, 1280])
def test_no_text_of_a_run_makes_the_page_scroll_sideways(worst_page, browser, width):
    browser.open(worst_page, width=width, height=844, mobile=width < 700)
    browser.run("document.querySelectorAll('details').forEach(d => d.open = true)")
    browser.run("[0.01, 0.5, 0.99].forEach(t => moveCursor(t * DATA.time[1], byId('inliers')))")
    assert browser.run("document.documentElement.scrollWidth") == width
    assert browser.errors == []
