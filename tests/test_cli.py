"""The command line as a user meets it: every mistake gets one line that says what to do."""

import argparse
import json
import os
import pty
import shlex
import signal
import subprocess
import sys
import time

import cv2
import numpy as np
import pytest
from fake_slam import FakeSlam

import edgeslam_torch.run
from edgeslam_torch import __version__, cli
from edgeslam_torch.command_line import full_parser
from edgeslam_torch.errors import SourceError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.help.examples import EXAMPLES, GROUPS


@pytest.fixture
def edgeslam(monkeypatch, capsys):
    """Run a command line with the fake system: returns exit code, stdout, stderr."""
    monkeypatch.setattr(edgeslam_torch.run, "_edge_slam", lambda camera, config, realtime, imu: FakeSlam())

    def call(*words):
        try:
            code = cli.main([str(word) for word in words])
        except SystemExit as end:
            code = end.code
        out, err = capsys.readouterr()
        return code, out, err

    return call


@pytest.fixture
def recording(tmp_path, write_tum):
    folder = write_tum(tmp_path / "seq", 6)
    save_camera(folder / "camera.yaml", Camera(64, 48, 50.0, 50.0, 31.5, 23.5))
    return folder


def test_run_says_what_came_of_it_and_settings_reach_the_resolved_config(edgeslam, recording, tmp_path):
    (tmp_path / "c.toml").write_text("seed = 1\n[orb]\nfeatures = 700\n")
    words = ("--config", tmp_path / "c.toml", "--set", "orb.levels=6", "--seed", 9, "--depth", "none", "--no-report")
    code, out, err = edgeslam("run", recording, "--out", tmp_path / "out", *words)
    assert code == 0
    assert "6 of 6 frames tracked (100.0 %), never lost" in out
    assert "units are metres" in out
    assert "camera.yaml" in err
    assert np.loadtxt(tmp_path / "out" / "trajectory.txt").shape == (6, 8)
    text = (tmp_path / "out" / "config.toml").read_text()
    for line in ("seed = 9", "features = 700", "levels = 6", 'weights = "none"'):
        assert line in text


@pytest.mark.parametrize("redraw", [[], ["--progress"]])
def test_progress_shows_loading_frames_and_the_last_refinement(edgeslam, recording, tmp_path, monkeypatch, redraw):
    monkeypatch.setattr("edgeslam_torch.terminal.progress.LINE_EVERY_S", 0.0)
    monkeypatch.setattr("edgeslam_torch.terminal.progress.SHOWN_EVERY_S", 0.001)
    _, _, err = edgeslam("run", recording, "--out", tmp_path / "o", "--no-report", *redraw)
    assert "opening the source" in err
    assert "6 of 6 frames" in err
    assert "last refinement" in err
    assert ("\r" in err) == bool(redraw)


MISTAKES = [
    ("run {tmp}/nowhere", 1, "nowhere"),
    ("run {tmp}/empty", 1, "empty"),
    ("run {seq} --camera tum_fr7", 1, "tum_fr1"),
    ("run {seq} --camera {seq}/rgb.txt", 1, "rgb.txt"),
    ("run {seq} --telemetry {tmp}/t.csv", 1, "t.csv"),
    ("run {seq} --config {tmp}/c.toml", 1, "c.toml"),
    ("run {seq} --set orb.feature=3", 1, "orb.features"),
    ("run {seq} --set fusion.velocity_step_m_s=0", 1, "velocity_step_m_s"),
    ("run {seq} --set orb.levels=21", 1, "must be at most"),
    ("run {seq} --set orb.features=2000000000", 1, "must be at most"),
    ("run {seq} --out {seq}", 1, "source itself"),
    ("run {seq} --out {seq}/rgb.txt/x", 1, "rgb.txt"),
    ("run {seq} --max-frames 0", 2, "'0'"),
    ("batch {seq} -o {tmp}/o --jobs 0", 2, "--jobs"),
    ("batch {seq} -o {tmp}/o --memory=-5", 2, "--memory"),
    ("batch {seq} -o {tmp}/o --timeout nan", 2, "--timeout"),
    ("judge {tmp} -o {tmp}/o --first-seed=-1", 2, "--first-seed"),
    ("run {seq} --seed " + "9" * 20, 2, "--seed"),
    ("run {seq} --seed=-1", 1, "--seed"),
    ("demo --seconds nan", 2, "--seconds"),
    ("record webcam:0 --fly", 1, "--fly"),
    ("run webcam:-1", 1, "webcam:N"),
    ("report {tmp}/deep", 1, "summary.json"),
    ("run {seq} --mode fast", 2, "invalid choice"),
    ("data", 2, "list|get"),
    ("run {seq} --camra x", 2, "did you mean '--camera'?"),
    ("run {seq} --max 5", 2, "did you mean '--max-frames'?"),
    ("run {seq} more", 2, "'more'"),
    ("run", 2, "SOURCE"),
    ("rnu {seq}", 2, "did you mean 'run'?"),
    ("{seq}", 2, "did you mean 'edgeslam run"),
]


@pytest.mark.parametrize(("words", "code", "message"), MISTAKES, ids=[words[:60] for words, _, _ in MISTAKES])
def test_mistake_gets_one_line_and_no_traceback(edgeslam, recording, tmp_path, words, code, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "deep").mkdir()
    (tmp_path / "deep" / "trajectory.txt").write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    (tmp_path / "deep" / "summary.json").write_text("[" * 100_000)
    got, out, err = edgeslam(*words.format(tmp=tmp_path, seq=recording).split())
    assert got == code
    (line,) = [line for line in err.splitlines() if "error:" in line]
    assert message in line and len(line) < 500 and "Traceback" not in err


def test_help_version_and_completion(edgeslam, monkeypatch):
    monkeypatch.setitem(cli.COMMANDS, "fly", ("edgeslam_torch.commands.fly_away", "leave"))
    assert "fly" not in cli.available() and edgeslam("fly")[0] == 2
    code, out, _ = edgeslam("--help")
    assert code == 0
    assert all(f"  {name} " in out for name in cli.available())
    code, out, _ = edgeslam("--version")
    assert (code, out) == (0, f"edgeslam {__version__}\n")
    code, out, _ = edgeslam()
    assert code == 2 and "commands:" in out
    for shell in ("bash", "zsh"):
        code, out, _ = edgeslam("--print-completion", shell)
        assert code == 0 and "export-map" in out and "--save-atlas" in out


def test_every_command_has_a_group_and_examples_that_parse():
    assert sorted(name for names in GROUPS.values() for name in names) == sorted(cli.COMMANDS)
    parser = full_parser(cli.available())
    for name in cli.COMMANDS:
        for line in EXAMPLES[name]:
            words = shlex.split(line)
            assert words[:2] == ["edgeslam", name]
            if name not in ("finetune", "distil"):  # whose weights must exist
                parser.parse_args(words[1:])
    (commands,) = (action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for name, lines in EXAMPLES.items():
        assert all(line in commands[name].format_help() for line in lines)


def test_ctrl_c_while_loops_compile_is_not_lost():
    """LLVM calls Python while it compiles, and drops what that raises."""
    code = """
import os, signal, sys, threading
from llvmlite.binding.executionengine import ExecutionEngine
from edgeslam_torch import cli, command_line

find = ExecutionEngine._find_module_ptr  # called by the callback

def interrupted(engine, pointer):
    os.kill(os.getpid(), signal.SIGINT)
    return find(engine, pointer)

def command(words, commands):
    import numba
    ExecutionEngine._find_module_ptr = interrupted
    numba.njit(lambda x: x + 1)(1)
    threading.Event().wait(20)

command_line.run_command = command
sys.exit(cli.main())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (130, "edgeslam: interrupted\n")


IN_A_TERMINAL = """
import fcntl, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
import edgeslam_torch.run
from edgeslam_torch.cli import main
from fake_slam import FakeSlam
edgeslam_torch.run._edge_slam = lambda camera, config, realtime, imu: FakeSlam()
sys.exit(main())
"""


def test_closed_terminal_leaves_a_map(write_tum, tmp_path):
    """The program runs in a terminal of its own, which is closed once the first frame is through."""
    out = tmp_path / "out"
    words = ["run", str(write_tum(tmp_path / "seq", 50)), "--out", str(out), "--no-report", "--mode", "realtime"]
    ours, its = pty.openpty()
    child = subprocess.Popen(
        [sys.executable, "-c", IN_A_TERMINAL, *words],
        stdin=its,
        stdout=its,
        stderr=its,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    os.close(its)
    while child.poll() is None and not (out / "status.csv").exists():
        time.sleep(0.01)
    os.close(ours)
    assert child.wait() == 129
    assert (out / "edge_map.ply").is_file()
    assert json.loads((out / "summary.json").read_text())["ended_early"] == "interrupted"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize(
    "words",
    [
        "run {p}",
        "run {seq} --set depth.weights={p}",
        "compare {p} {p}",
        "weights inspect {p}",
        "finetune {p} -o {tmp}/o",
    ],
)
def test_pipes_and_devices_are_refused_wherever_they_are_named(edgeslam, recording, tmp_path, words):
    os.mkfifo(tmp_path / "pipe")
    for name in (tmp_path / "pipe", "/dev/zero"):
        code, _, err = edgeslam(*words.format(p=name, seq=recording, tmp=tmp_path).split())
        assert (code, len(err.strip().splitlines())) == (1, 1)
        assert "neither a regular file nor a folder" in err or "not a regular file" in err


@pytest.mark.timeout(60)
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
@pytest.mark.parametrize(
    "words",
    [
        "run {seq} -o {run} --no-report",
        "eval {run} -g {seq}",
        "report {run} --overwrite",
        "export-map {run} --format colmap -o {tmp}/colmap",
    ],
)
def test_a_pipe_in_a_folder_of_somebody_else_is_not_waited_for(edgeslam, recording, tmp_path, words):
    """In place of each file in turn; what is not needed may be missing."""
    (recording / "groundtruth.txt").write_text("".join(f"{100 + 0.1 * i} {i} 0 0 0 0 0 1\n" for i in range(6)))
    (recording / "telemetry.csv").write_text("stamp_s,vgx,vgy,vgz,pitch,roll,yaw,tof\n100,0,0,0,0,0,0,100\n")
    run = tmp_path / "run"
    assert edgeslam("run", recording, "-o", run, "--no-report")[0] == 0
    images = sorted((recording / "rgb").iterdir())
    for path in [*run.iterdir(), *(p for p in recording.iterdir() if p.is_file()), images[2]]:
        content = path.read_bytes()
        path.unlink()
        os.mkfifo(path)
        code, _, err = edgeslam(*words.format(run=run, seq=recording, tmp=tmp_path).split())
        assert (code == 0) or "error:" in err
        path.unlink(missing_ok=True)
        path.write_bytes(content)


def test_what_was_never_tracked_was_not_never_lost(edgeslam, recording, tmp_path):
    for image in (recording / "rgb").iterdir():
        cv2.imwrite(str(image), np.zeros((48, 64), np.uint8))
    code, out, _ = edgeslam("run", recording, "--out", tmp_path / "out", "--no-report")
    assert code == 1, "nothing tracked is no success"
    assert "0 of 6 frames tracked (0.0 %), " in out
    assert "lost" not in out


def test_a_part_of_a_recording_is_run(edgeslam, recording, tmp_path):
    def stamps(name, *words):
        assert edgeslam("run", recording, "-o", tmp_path / name, *words)[0] == 0
        rows = (tmp_path / name / "status.csv").read_text().splitlines()
        return [row.split(",")[rows[0].split(",").index("stamp_s")] for row in rows[1:]]

    whole = stamps("whole")
    assert stamps("part", "--start", "1", "--stride", "2", "--max-frames", "2") == whole[1:4:2]
    code, _, err = edgeslam("run", recording, "-o", tmp_path / "none", "--start", "5000")
    assert code == 1 and "5000" in err
    assert edgeslam("run", "webcam:0", "--stride", "2")[0] == 1


def test_verbose_shows_the_traceback(edgeslam, tmp_path):
    with pytest.raises(SourceError):
        edgeslam("run", tmp_path / "nowhere", "-v")


CTRL_C_AT_IMPORT = """
import os, signal, sys, threading

class CtrlC:
    def find_spec(name, path=None, target=None):
        if name == at:
            before = threading.active_count()
            for _ in range(int(times)):
                os.kill(os.getpid(), signal.SIGINT)
            print(threading.active_count() - before)

times, at = sys.argv.pop(), sys.argv.pop()
sys.meta_path.insert(0, CtrlC)
from edgeslam_torch.cli import main
sys.exit(main())
"""


@pytest.mark.parametrize(("module", "times"), [("argparse", "200"), ("datetime", "1")])
def test_ctrl_c_while_modules_load_ends_with_one_line(recording, tmp_path, module, times):
    """However often: a thread for every signal used up all that a process may have. numpy makes an ImportError of what
    comes while it looks for datetime."""
    words = ["run", str(recording), "--out", str(tmp_path / "out"), module, times]
    done = subprocess.run([sys.executable, "-c", CTRL_C_AT_IMPORT, *words], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.splitlines()[-1]) == (130, "1\n", "edgeslam: interrupted")
    assert "Traceback" not in done.stderr


def test_program_ends_without_a_word_when_interrupted_at_its_end():
    code = "import os, signal, sys; from edgeslam_torch.cli import main; main(); os.kill(os.getpid(), signal.SIGINT)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (-signal.SIGINT, "")


def test_runs_without_out_are_numbered_and_none_is_replaced(edgeslam, recording, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("seq", "seq-2", "seq-3"):
        assert edgeslam("run", recording, "--no-report")[0] == 0
        assert (tmp_path / "runs" / name / "trajectory.txt").is_file()


def test_images_of_others_are_not_replaced_by_kept_ones(edgeslam, recording, tmp_path):
    theirs = tmp_path / "out" / "images" / "1.000000.jpg"
    theirs.parent.mkdir(parents=True)
    theirs.write_text("precious")
    words = ("run", recording, "--out", tmp_path / "out", "--no-report")
    assert edgeslam(*words, "--keep-images")[0] == 1
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == [theirs]
    assert edgeslam("run", recording, "--out", tmp_path / "own", "--no-report", "--keep-images")[0] == 0
    assert edgeslam("run", recording, "--out", tmp_path / "own", "--no-report", "--keep-images")[0] == 0


def test_a_recording_is_no_run_to_view_or_report(edgeslam, recording):
    (recording / "groundtruth.txt").write_text("100.0 0 0 0 0 0 0 1\n100.1 0 0 0 0 0 0 1\n")
    before = sorted(recording.iterdir())
    for command in (("view", "--print"), ("report",)):
        code, _, err = edgeslam(command[0], recording, *command[1:])
        assert code == 1 and "no run wrote" in err
    assert sorted(recording.iterdir()) == before


def test_impossible_sources_are_one_short_line(edgeslam):
    for source in ("a" * 5000, "webcam:99999999999", "webcam:\u0663", "b/" * 3000):
        code, _, err = edgeslam("run", source)
        assert code == 1 and len(err.splitlines()) == 1 and len(err) < 3000
