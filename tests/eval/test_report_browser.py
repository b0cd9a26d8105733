"""The report in a real headless browser: no error, something drawn, every control works, no network."""

import html
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from edgeslam_torch.eval.report import write_report

BROWSER = next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium here: the report page is not opened")

PROBE = Path(__file__).with_name("report_probe.js")
CATCH = """<script>window.probeErrors = [];
addEventListener("error", e => probeErrors.push(String(e.message)));
addEventListener("unhandledrejection", e => probeErrors.push(String(e.reason)));
const consoleError = console.error; console.error = (...a) => { probeErrors.push(a.join(" ")); consoleError(...a); };
</script>"""


def open_in_browser(page: Path, width: int, height: int) -> dict[str, Any]:
    """What the probe found on the page."""
    text = page.read_text(encoding="utf-8")
    probed = page.with_name("probed.html")
    text = text.replace("<head>", "<head>" + CATCH, 1)
    probed.write_text(text.replace("</body>", f"<script>{PROBE.read_text()}</script></body>"), encoding="utf-8")
    command = [
        str(BROWSER),
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--host-resolver-rules=MAP * ~NOTFOUND",  # the network is off
        f"--user-data-dir={page.parent / 'profile'}",
        f"--window-size={width},{height}",
        "--virtual-time-budget=20000",
        "--dump-dom",
        probed.as_uri(),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=True)
    found = re.search(r'<pre id="probe">(.*?)</pre>', done.stdout, re.DOTALL)
    assert found, done.stdout[-2000:] + done.stderr[-2000:]
    return dict(json.loads(html.unescape(found.group(1))))


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, run_folder: Callable[..., Path]) -> Path:
    folder = tmp_path_factory.mktemp("report") / "run"
    truth = run_folder(folder, points=20_000)
    return write_report(folder, truth)


def test_every_control_of_the_page_works(page: Path) -> None:
    found = open_in_browser(page, 1200, 900)
    assert found["ready"] == "yes"
    assert found["errors"] == []
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


def test_page_fits_a_phone(page: Path) -> None:
    found = open_in_browser(page, 500, 900)  # headless chromium goes no narrower
    assert found["errors"] == []
    assert not found["wide"]
