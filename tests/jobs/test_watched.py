"""Watched processes; those here are tiny scripts."""

import subprocess
import sys
from contextlib import closing

import pytest

from edgeslam_torch.jobs.watched import How, Job, Limits, resident_mb, run_each

LIMITS = Limits(timeout_s=60.0)
LARGE = "import time; b = bytearray(300 << 20); b[::4096] = b'x' * len(b[::4096]); time.sleep(60)"
KILLED_ONCE = (
    "import os, pathlib, signal; seen = pathlib.Path('seen')\n"
    "if not seen.exists(): seen.touch(); os.kill(os.getpid(), signal.SIGKILL)\n"
)
KILLED = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"


def python(code, folder):
    """Starts a script that runs in a folder."""

    def start(path, log):
        return subprocess.Popen([sys.executable, "-S", "-c", code], stdout=log, stderr=log, text=True, cwd=folder)

    return start


def ends(tmp_path, codes, limits=LIMITS, jobs=2, retries=0):
    started = []

    def start(name):
        started.append(name)
        return Job(tmp_path, tmp_path / f"{name}.log", python(codes[name], tmp_path), limits)

    with closing(run_each(list(codes), start, jobs, retries)) as found:
        return dict(found), started


def test_process_that_takes_too_much_memory_is_ended_and_the_others_stay(tmp_path):
    if resident_mb(1) is None:
        pytest.skip("this system does not tell a process's memory")
    found, started = ends(tmp_path, {"large": LARGE, "small": "pass"}, Limits(60.0, memory_mb=150.0), retries=1)
    assert found["large"].how is How.TOO_LARGE
    assert found["large"].reason == "took more than 150 MB of memory"
    assert (found["small"].how, found["small"].reason) == (How.ITSELF, "")
    assert started == ["large", "small"], "what is too large once is too large again"


def test_killed_process_gets_one_more_attempt(tmp_path):
    found, started = ends(tmp_path, {"a": KILLED_ONCE, "b": KILLED, "c": "import os; os._exit(3)"}, retries=1)
    assert (found["a"].reason, found["a"].attempts) == ("", 2)
    assert (found["b"].how, found["b"].reason, found["b"].attempts) == (How.KILLED, "killed by signal 9", 2)
    assert (found["c"].reason, found["c"].attempts) == ("exit code 3", 1), "its own mistake is not repeated"
    assert sorted(started) == ["a", "a", "b", "b", "c"]


def test_late_process_is_ended(tmp_path):
    found, _ = ends(tmp_path, {"slow": "import time; time.sleep(60)"}, Limits(0.3), retries=1)
    assert (found["slow"].how, found["slow"].reason) == (How.LATE, "took longer than 0 s")


def test_whoever_stops_listening_ends_what_runs(tmp_path):
    jobs = []

    def start(name):
        code = "pass" if name == "quick" else "import time; time.sleep(60)"
        jobs.append(Job(tmp_path, tmp_path / f"{name}.log", python(code, tmp_path), LIMITS))
        return jobs[-1]

    with closing(run_each(["quick", "slow", "never"], start, 2)) as found:
        assert next(found)[0] == "quick"
    assert jobs[1].ended().reason == "killed by signal 9"
    assert len(jobs) == 2, "nothing is started any more"


def test_process_ends_with_the_one_that_holds_its_stdin():
    code = "from edgeslam_torch.jobs.watched import end_with_parent; end_with_parent(); import time; time.sleep(60)"
    child = subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE)
    child.stdin.close()  # as when its parent dies
    assert child.wait(timeout=30) == 1
