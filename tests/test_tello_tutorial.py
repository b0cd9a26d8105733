"""The first three commands of docs/guides/tello.md, as a user types them: only the ports are free ones."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from free_ports import free_ports

pytest.importorskip("av", reason="PyAV is not installed: the [drone] extra")
GUIDE = Path(__file__).resolve().parent.parent / "docs" / "guides" / "tello.md"


def commands():
    """The words of the guide's first block, comments left out."""
    block = GUIDE.read_text(encoding="utf-8").split("## Without a drone")[1].split("\n\n")[1]
    return [shlex.split(line, comments=True) for line in block.splitlines()]


def edgeslam(words):
    return [sys.executable, "-m", "edgeslam_torch.cli", *words[1:]]


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.timeout(580)
def test_the_guide_can_be_followed(tmp_path):
    """A flight, a map that its frames are tracked against, and metres."""
    sim, record, run = commands()
    command, state, video = free_ports(3)
    sim += [f"--command-port={command}", f"--state-port={state}", f"--video-port={video}"]
    record[record.index("tello://127.0.0.1")] += f":{command}:{state}:{video}"
    where = {"cwd": tmp_path, "env": os.environ | {"PYTHONPATH": str(GUIDE.parents[2])}, "text": True}
    with subprocess.Popen(edgeslam(sim), stdout=subprocess.PIPE, **where) as drone:
        try:
            assert "Tello emulator" in drone.stdout.readline()
            flown = subprocess.run(edgeslam(record), capture_output=True, **where)
        finally:
            drone.terminate()
    assert flown.returncode == 0, flown.stderr
    folder = record[record.index("--out") + 1]
    height_cm = [int(h) for h in re.findall(r";h:(-?\d+);", (tmp_path / folder / "state.txt").read_text())]
    assert max(height_cm) >= 100
    done = subprocess.run(edgeslam(run), capture_output=True, **where)
    assert done.returncode == 0, done.stderr
    summary = json.loads((tmp_path / "runs" / Path(folder).name / "summary.json").read_text())
    assert f"{summary['frames']} frames" in flown.stdout
    assert f"{summary['tracked']} of {summary['frames']} frames tracked" in done.stdout
    # All of 613 frames and 24 600 points when written, beside eight busy processes.
    assert summary["tracked"] > 0.9 * summary["frames"]
    assert summary["map"]["edge_points"] > 8000
    assert summary["scale"]["units"] == "metres"
