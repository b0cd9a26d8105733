"""``edgeslam view``: the page where it is, rerun only when asked for and only when installed."""

import argparse
import importlib.util
import subprocess
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edgeslam_torch.commands import view
from edgeslam_torch.errors import ConfigError
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.types import FrameStatus, ScaleEstimate, SlamOutput

HAS_RERUN = importlib.util.find_spec("rerun") is not None


def run_view(*words: object) -> int:
    parser = argparse.ArgumentParser()
    view.add_arguments(parser)
    return view.main(parser.parse_args([str(w) for w in words]))


def test_page_is_made_when_missing_and_opened(
    run_folder: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    run_folder(tmp_path / "a")
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: opened.append(address) or True)
    assert run_view(tmp_path / "a") == 0
    assert opened == [(tmp_path / "a" / "report.html").resolve().as_uri()]
    assert str(tmp_path / "a" / "report.html") in capsys.readouterr().out
    assert run_view(tmp_path / "a", "--print") == 0 and len(opened) == 1


@pytest.mark.skipif(HAS_RERUN, reason="rerun is installed here")
def test_missing_rerun_is_said_with_the_remedy(run_folder: Callable[..., Path], tmp_path: Path) -> None:
    run_folder(tmp_path / "a")
    with pytest.raises(ConfigError, match=r"pip install 'edgeslam-torch\[viewer\]'"):
        run_view(tmp_path / "a", "--viewer")


def test_rerun_is_not_imported_by_the_module() -> None:
    code = "import sys, edgeslam_torch.viewer; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.skipif(not HAS_RERUN, reason="rerun is not installed: the [viewer] extra is not tried")
def test_recordings_of_live_and_finished_runs_are_written(run_folder: Callable[..., Path], tmp_path: Path) -> None:
    from edgeslam_torch.viewer import Viewer

    run_folder(tmp_path / "a")
    assert run_view(tmp_path / "a", "--save-rrd", tmp_path / "a.rrd") == 0
    assert (tmp_path / "a.rrd").stat().st_size > 10_000
    viewer = Viewer("live", save=tmp_path / "live.rrd", show=False)
    viewer.camera(PRESETS["kinect"])
    scale = ScaleEstimate(1.0, 0.1, "depth")
    for k in range(3):
        output = SlamOutput(k, k / 30, np.eye(4), FrameStatus.TRACKED, "", 9, 8, 0.1, True, scale, {"tracking": 4.0})
        image = np.full((480, 640, 3), 100, np.uint8)
        viewer.step(output, image, np.ones((5, 2)), np.ones((7, 2)), np.ones((48, 64), np.float32))
    viewer.close()
    assert (tmp_path / "live.rrd").stat().st_size > 10_000
