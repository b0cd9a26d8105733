"""The run loop around a SLAM system that knows the answer."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from fake_slam import FakeSlam

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import EdgeSlamError, SourceError, WeightsError
from edgeslam_torch.eval.inputs.run_folder import open_run
from edgeslam_torch.files.config_file import load_config
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.readers.pace import Counter, at_their_pace
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.run import AtlasFiles, Mode, run
from edgeslam_torch.types import Frame, TelemetrySample
from edgeslam_torch.writers import run_summary
from edgeslam_torch.writers.ply import read_ply

FILES = {
    "trajectory.txt",
    "trajectory_online.txt",
    "status.csv",
    "edge_map.ply",
    "anchors.ply",
    "summary.json",
    "config.toml",
    "camera.yaml",
    "map.png",
    "observations.npz",
}


def fake(slam):
    return lambda camera, config, realtime: slam


def test_folder_holds_everything(tmp_path, write_tum):
    source = open_source(write_tum(tmp_path / "seq", 12))
    result = run(source, tmp_path / "out", SlamConfig(seed=3), make_slam=fake(FakeSlam()))
    assert {p.name for p in result.folder.iterdir()} == FILES
    summary = json.loads((result.folder / "summary.json").read_text())
    wanted = "frames tracked coverage first_pose_frame lost_events fps cpu_ms_per_frame peak_rss_mb dropped_frames"
    assert set(wanted.split()) <= set(summary)
    assert (summary["frames"], summary["coverage"], summary["first_pose_frame"], summary["seed"]) == (12, 1.0, 0, 3)
    assert summary["scale"] == {"value": 1.0, "sigma": 0.02, "source": "depth", "units": "metres"}
    assert summary["map"] == {"keyframes": 3, "anchors": 500, "edge_points": 500}
    assert summary["stage_median_ms"] == {"features": 1.0, "mapping": 5.0}
    assert np.loadtxt(result.folder / "trajectory.txt").shape == (12, 8)
    with (result.folder / "status.csv").open() as file:
        named = [row["image"] for row in csv.DictReader(file)]
    assert named == [f"rgb/{100 + 0.1 * i:.6f}.png" for i in range(12)]
    assert len(read_ply(result.folder / "edge_map.ply").p_w) == 500
    assert load_config(SlamConfig(), result.folder / "config.toml") == SlamConfig(seed=3)
    assert cv2.imread(str(result.folder / "map.png")).shape[1] > 1000


@pytest.mark.parametrize(
    "error", [SourceError("the camera is gone"), RuntimeError("the camera is gone"), MemoryError()]
)
@pytest.mark.parametrize("where", ["source", "step", "listener", "finish", "on_last_frame", "on_finish"])
def test_what_ends_a_run_early_is_in_the_summary_and_raised(tmp_path, write_tum, error, where):
    def fail(frame, *_):
        if frame.index == 4:
            raise error
        return step(frame, *_) if where == "step" else frame

    def fail_at_the_end(*_):
        raise error

    slam = FakeSlam()
    step = slam.step
    if where == "step":
        slam.step = fail
    if where == "finish":
        slam.finish = fail_at_the_end
    listeners = [SimpleNamespace(on_frame=fail, on_finish=lambda _: None)] if where == "listener" else []
    if where.startswith("on_"):
        calls = {"on_frame": lambda *_: None, "on_finish": lambda _: None, where: fail_at_the_end}
        listeners = [SimpleNamespace(**calls)]
    source = open_source(write_tum(tmp_path / "seq", 12))
    if where == "source":
        recorded = source.frames
        source.frames = lambda: map(fail, recorded())
    with pytest.raises(type(error)):
        run(source, tmp_path / "out", make_slam=fake(slam), listeners=listeners)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["ended_early"] == (str(error) or "MemoryError")
    assert summary["frames"] == {"source": 4, "step": 4, "listener": 5}.get(where, 12)
    assert len(np.loadtxt(tmp_path / "out" / "trajectory.txt")) == summary["frames"]
    assert {p.name for p in (tmp_path / "out").iterdir()} == FILES


def test_warnings_of_source_system_and_run_are_in_the_summary(tmp_path, write_tum):
    source, slam = open_source(write_tum(tmp_path / "seq", 2)), FakeSlam()
    source.warnings.append("no calibration")
    slam.warnings = lambda: ["no depth"]
    # Frames from 100 s on: what is stamped later never reaches the system, which cannot know that it is there.
    source.telemetry = [TelemetrySample(500.0 + 0.1 * k) for k in range(50)]
    summary = run(source, tmp_path / "out", make_slam=fake(slam)).summary
    assert {"no calibration", "no depth"} <= set(summary["warnings"])
    assert any("stamped after the frames" in w for w in summary["warnings"])


def test_lost_and_unreadable_frames_cost_coverage_and_are_counted(tmp_path, write_tum):
    folder = write_tum(tmp_path / "seq", 10)
    images = sorted((folder / "rgb").iterdir())
    images[2].write_bytes(b"")
    for path in images[4:7]:
        cv2.imwrite(str(path), np.zeros((48, 64), np.uint8))
    summary = run(open_source(folder), tmp_path / "out", make_slam=fake(FakeSlam())).summary
    assert (summary["frames"], summary["left_out"], summary["offered"]) == (9, 1, 10)
    assert (summary["tracked"], summary["lost_events"], summary["coverage"]) == (6, 1, 0.6)
    assert summary["statuses"] == {"tracked": 6, "predicted": 3}
    assert "empty" in summary["problems"][0]["reason"]


def test_results_name_no_folder_of_the_disk_and_find_the_recording_when_both_move(tmp_path, write_tum):
    folder = write_tum(tmp_path / "here" / "data" / "seq", 4)
    save_camera(folder / "camera.yaml", Camera(64, 48, 50.0, 50.0, 31.5, 23.5))
    sorted((folder / "rgb").iterdir())[3].write_bytes(b"")
    out = run(open_source(folder), tmp_path / "here" / "runs" / "a", make_slam=fake(FakeSlam())).folder
    assert not [path.name for path in out.iterdir() if str(tmp_path).encode() in path.read_bytes()]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["source"]["path"] == "../../data/seq"
    assert summary["problems"][0]["file"] == "rgb/100.300000.png"
    assert summary["camera"]["source"] == "seq/camera.yaml"
    (tmp_path / "here").rename(tmp_path / "there")
    found = open_run(tmp_path / "there" / "runs" / "a").source
    assert found is not None and found.samefile(tmp_path / "there" / "data" / "seq")


def test_telemetry_comes_with_the_frame_that_follows_it(tmp_path, write_tum):
    source = open_source(write_tum(tmp_path / "seq", 4))  # frames at 100.0, 100.1, 100.2, 100.3
    source.telemetry.extend(TelemetrySample(stamp) for stamp in (99.0, 100.0, 100.15, 100.2, 500.0))
    slam = FakeSlam()
    run(source, tmp_path / "out", make_slam=fake(slam))
    assert [[s.stamp_s for s in group] for group in slam.telemetry] == [[99.0, 100.0], [], [100.15, 100.2], []]


@pytest.mark.parametrize(("number", "times"), [(signal.SIGINT, 1), (signal.SIGTERM, 2), (signal.SIGHUP, 2)])
def test_a_signal_finishes_and_writes_even_when_sent_twice(tmp_path, write_tum, number, times):
    def send(step):
        for _ in range(times if step == 5 else 0):
            os.kill(os.getpid(), number)

    slam = FakeSlam(on_step=send)
    handler = signal.getsignal(number)
    result = run(open_source(write_tum(tmp_path / "seq", 20)), tmp_path / "out", make_slam=fake(slam))
    assert result.interrupted and slam.finished
    assert {p.name for p in result.folder.iterdir()} == FILES
    assert json.loads((result.folder / "summary.json").read_text())["interrupted"] is True
    assert len(np.loadtxt(result.folder / "trajectory.txt")) == 6
    assert signal.getsignal(number) is handler


@pytest.mark.parametrize("end", ["no frame", "interrupt", "no weights"])
def test_a_run_that_comes_to_nothing_leaves_the_older_run(tmp_path, write_tum, end):
    folder = write_tum(tmp_path / "seq", 2)
    run(open_source(folder), tmp_path / "out", make_slam=fake(FakeSlam()))
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}
    source = open_source(folder)

    def nothing():
        if end == "interrupt":
            os.kill(os.getpid(), signal.SIGINT)
        yield from ()

    def make(camera, config, realtime):
        if end == "no weights":
            raise WeightsError("no such weights")
        return FakeSlam()

    source.frames = nothing
    message = {"no frame": "provided no frame", "interrupt": "nothing was written", "no weights": "no such weights"}
    with pytest.raises(EdgeSlamError, match=message[end]):
        run(source, tmp_path / "out", make_slam=make)
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before


@pytest.mark.parametrize("converted", [False, True])
def test_second_ctrl_c_skips_the_refinement_and_still_writes(tmp_path, write_tum, converted):
    """Compiled loops turn the interruption into another error."""

    class Slow(FakeSlam):
        def finish(self):
            try:
                os.kill(os.getpid(), signal.SIGINT)
                os.kill(os.getpid(), signal.SIGINT)
            except KeyboardInterrupt as interruption:
                raise SystemError("result with an exception set") if converted else interruption from interruption

    result = run(open_source(write_tum(tmp_path / "seq", 5)), tmp_path / "out", make_slam=fake(Slow()))
    assert {p.name for p in result.folder.iterdir()} == FILES
    assert result.summary["ended_early"] == "interrupted"


def test_ctrl_c_while_a_live_source_is_silent(tmp_path, write_tum):
    source = open_source(write_tum(tmp_path / "seq", 3))
    recorded = source.frames

    def silent_after_two():
        frames = recorded()
        yield next(frames)
        yield next(frames)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60.0)

    source.frames, source.live = silent_after_two, True  # offline the next frames are already being prepared
    result = run(source, tmp_path / "out", make_slam=fake(FakeSlam()))
    assert result.interrupted
    assert result.summary["frames"] == 2


def test_an_atlas_that_could_not_be_written_is_not_said_to_be_saved(tmp_path, write_tum, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    slam = FakeSlam()
    slam.saved_atlas = lambda name: SimpleNamespace(summary=lambda: {"keyframes": 3, "anchors": 5, "flights": 1})
    monkeypatch.setattr("edgeslam_torch.atlas.atlas_file.write_atlas", full)
    atlas = AtlasFiles(save=tmp_path / "a.atlas")
    result = run(open_source(write_tum(tmp_path / "seq", 3)), tmp_path / "out", make_slam=fake(slam), atlas=atlas)
    assert "No space left" in result.failure
    assert result.summary["saved_atlas"] is None
    assert json.loads((result.folder / "summary.json").read_text())["saved_atlas"] is None


def test_memory_is_the_runs_own_and_not_that_of_the_process_that_started_it():
    code = "from edgeslam_torch.writers.run_summary import peak_rss_mb; print(peak_rss_mb())"
    large = np.ones(100 << 20, np.uint8)  # 100 MB that a child takes over by fork
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    here = run_summary.peak_rss_mb()
    assert float(done.stdout) < here - 0.9 * large.nbytes / 2**20


def test_nohup_goes_on_when_the_terminal_closes(tmp_path, write_tum):
    def hang_up(step):
        os.kill(os.getpid(), signal.SIGHUP)

    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        result = run(
            open_source(write_tum(tmp_path / "seq", 3)), tmp_path / "out", make_slam=fake(FakeSlam(on_step=hang_up))
        )
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
    assert not result.interrupted and result.summary["frames"] == 3


def test_ctrl_c_while_results_are_written_loses_none_and_nothing_maps_beside(tmp_path, write_tum):
    class Watched(FakeSlam):
        closed = False

        def close(self):
            self.closed = True

        def trajectory(self):
            assert self.closed
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
            return super().trajectory()

    result = run(open_source(write_tum(tmp_path / "seq", 3)), tmp_path / "out", make_slam=fake(Watched()))
    assert {p.name for p in result.folder.iterdir()} == FILES


def frames_at(stamps):
    image = np.zeros((4, 4), np.uint8)
    return iter([Frame(i, stamp, image) for i, stamp in enumerate(stamps)])


def test_realtime_keeps_pace_and_drops_the_oldest_waiting():
    dropped = Counter()
    frames = at_their_pace(frames_at(0.002 * i for i in range(50)), dropped, waiting=2)
    first = next(frames)
    until = time.monotonic() + 0.05
    while time.monotonic() < until:
        pass  # a slow step
    rest = list(frames)
    order = [frame.index for frame in (first, *rest)]
    assert order == sorted(order)
    assert 1 + len(rest) + dropped.value == 50
    assert dropped.value > 5
    assert rest[-1].index == 49


def test_realtime_drops_nothing_when_there_is_time(tmp_path, write_tum):
    result = run(
        open_source(write_tum(tmp_path / "seq", 3)), tmp_path / "out", mode=Mode.REALTIME, make_slam=fake(FakeSlam())
    )
    assert result.summary["dropped_frames"] == 0
    assert result.summary["frames"] == 3
    assert result.summary["duration_s"] > 0.19
