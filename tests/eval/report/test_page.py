"""Contents of ``report.html``, also for hostile names and numbers."""

import shutil

import cv2
import numpy as np
import pytest
from pages import Page
from summaries import with_summary

from edgeslam_torch import open_source
from edgeslam_torch.eval.inputs.run_folder import open_run
from edgeslam_torch.eval.report.page import write_report
from edgeslam_torch.eval.report.words import without_folders
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.camera_file import save_camera

NAMES = (
    "{{edges}}",
    "{{data}} {{title}} {{script}}",
    "</script><script>document.title = 'broken'</script>",
    "</title><b>bold</b>",
    "<!--<script>",
    '"&quot;\\u003c',
    r"\1 \g<0>",
    "line\u2028line",
    "bytes \udcff of no encoding",
)


@pytest.fixture
def run(run_folder, tmp_path):
    run_folder(tmp_path / "run", points=100)
    return tmp_path / "run"


def test_no_text_of_a_run_breaks_the_page(run):
    plain = Page(write_report(with_summary(run, source={"name": "plain"})))
    for name in NAMES:
        page = Page(write_report(with_summary(run, source={"name": name, "path": f"/nowhere/{name}"})))
        shown = name.replace("\udcff", "?")
        assert page.data["title"] == shown
        assert page.texts["title"] == f"{shown}, EdgeSLAM-Torch"
        assert page.tags == plain.tags, "the name made elements"
        assert page.texts["edges-data"] == plain.texts["edges-data"]
        assert page.texts["script"] == plain.texts["script"]
    for name in NAMES[:5]:
        (run / "config.toml").write_text(name)
        (run / "status.csv").write_text(f'stamp_s,status,reason\n100.0,lost,"{name}"\n')
        page = Page(write_report(with_summary(run, warnings=[name])))
        assert page.tags == plain.tags
        assert page.data["config"] == page.data["events"][0][4] == page.data["warnings"][0] == name


def test_a_large_map_is_shown_by_a_part_of_its_points(run, monkeypatch):
    whole = len(Page(write_report(run)).texts["edges-data"])
    monkeypatch.setattr("edgeslam_torch.eval.report.page.MAX_POINTS", 40)  # of 100
    assert len(Page(write_report(run)).texts["edges-data"]) == pytest.approx(0.4 * whole, rel=0.02)


PIECES = [
    {"number": k, "supported": 5, "first_s": a, "last_s": b} for k, (a, b) in enumerate([(0, 8.133), (8.167, 11)])
]


@pytest.mark.parametrize(
    ("summary", "told"),
    [
        ({"pieces": PIECES}, ["from 0.0 to 8.1 s", "from 8.2 to 11.0 s"]),
        ({"joins": ["piece 1 joined piece 0"], "loops": [f"loop {k} closed" for k in range(7)]}, ["loop 0", "3 more"]),
        (
            {"offered": 400, "left_out": 150, "dropped_frames": 50},
            ["400 ", "150 ", "50 ", "49.2\u00a0%"],
        ),  # 197 tracked
    ],
)
def test_story_has_the_runs_own_figures(run, summary, told):
    story = Page(write_report(with_summary(run, **summary), judge_map=False)).data["story"]
    assert all(text in story for text in told), story


def test_events_are_the_stretches_that_were_not_plainly_tracked(run):
    data = Page(write_report(run)).data
    assert data["events"] == [
        ["0.00 s", "0.05 s", "2", "initialised", "depth prior"],
        ["4.50 s", "4.60 s", "3", "lost", "few matches (7) </script><b>"],
        ["4.65 s", "4.65 s", "1", "relocalised", "keyframe 4"],
    ]
    assert data["matches"][:10] == [300, 304, 308, 313, 317, 321, 324, 328, 331, 333]


def test_page_tells_nothing_about_the_disk(run):
    secret = "/home/Jane Doe/projects"
    with_summary(
        run,
        source={"name": "kitchen", "path": f"{secret}/kitchen"},
        camera={"width": 640, "source": f"{secret}/kitchen/camera.yaml"},
        command=f"edgeslam run {secret}/kitchen",
        warnings=[f"{secret}/kitchen/telemetry.csv: no sample overlaps a frame"],
        problems=[{"file": f"{secret}/kitchen/1.png", "reason": "cannot be read"}],
    )
    (run / "config.toml").write_text(f'[depth]\nweights = "{secret}/weights.safetensors"\n')
    (run / "status.csv").write_text(f"stamp_s,status,reason\n100.0,lost,{secret}/kitchen/1.png: dark\n")
    page = write_report(run).read_text(encoding="utf-8")
    assert "Jane" not in page and "projects" not in page
    for kept in ("camera.yaml", "telemetry.csv: no sample", "1.png, reason cannot", "weights.safetensors", "kitchen"):
        assert kept in page


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("/data/a b/camera.yaml, 640x480", "camera.yaml, 640x480"),
        (r"C:\Users\Jane Doe\x.yaml: bad", "x.yaml: bad"),
        (r"\\server\share\x", "x"),
        ("edgeslam run /a/b --out /c/d", "edgeslam run b --out d"),
        ("../../home/Jane Doe/kitchen", "kitchen"),
        ("rgb/0001.png, 3 m/s, a / b, /, ..", "rgb/0001.png, 3 m/s, a / b, /, .."),
        ("tello://192.168.10.1/x", "tello://192.168.10.1/x"),
    ],
)
def test_paths_that_leave_the_run_keep_their_last_name_only(text, shown):
    assert without_folders(text) == shown


@pytest.mark.parametrize("value", [None, "text", [1], {"value": []}, -1, 10**400, True])
@pytest.mark.parametrize(
    "keys", ["offered frames peak_rss_mb source pieces", "left_out fps scale lost_events joins loops"]
)
def test_summary_of_wrong_types_is_a_page_all_the_same(run, keys, value):
    page = Page(write_report(with_summary(run, **dict.fromkeys(keys.split(), value)), judge_map=False))
    assert page.data["title"]


@pytest.mark.parametrize("telemetry", [False, True])
def test_keyframes_are_drawn_from_a_recording_with_and_without_telemetry(run, telemetry):
    recording = run.parent / "recording"
    (recording / "rgb").mkdir(parents=True)
    stamps_s = open_run(run).trajectory.stamps_s[:60:10]
    for k in range(len(stamps_s)):
        cv2.imwrite(str(recording / "rgb" / f"{k}.png"), np.full((480, 640, 3), 20 * k, np.uint8))
    lines = [f"{stamp_s:.6f} rgb/{k}.png\n" for k, stamp_s in enumerate(stamps_s)]
    (recording / "rgb.txt").write_text("".join(lines))
    if telemetry:
        rows = [f"{stamp_s:.3f},0.1,0,0,0,0,0\n" for stamp_s in np.arange(100.0, 103.0, 0.1)]
        (recording / "telemetry.csv").write_text("stamp_s,vx,vy,vz,roll,pitch,yaw\n" + "".join(rows))
    for folder in (run, recording):
        save_camera(folder / "camera.yaml", PRESETS["kinect"])
    shutil.rmtree(run / "keyframes")
    source = {"path": "../recording", "kind": open_source(recording).kind}
    page = Page(write_report(with_summary(run, source=source), None))
    assert page.data["keyframes"]
