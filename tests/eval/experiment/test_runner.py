"""Cells as processes: results kept, crashes and time-outs as rows; the processes here are tiny scripts."""

import json
import subprocess
import sys

import pytest

from edgeslam_torch.errors import OutputError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment import runner
from edgeslam_torch.eval.experiment.runner import Local, Task
from edgeslam_torch.eval.judge.cells import Cell
from edgeslam_torch.eval.judge.runner import JudgeSettings, judge
from edgeslam_torch.jobs.watched import Limits

GOOD = (
    "import json, sys, pathlib; f = pathlib.Path(sys.argv[1]); key = json.loads((f / 'case.json').read_text())['key'];"
    "figures = {'frames': 5, 'supported_end': 1.0, 'ate_m': 0.01};"
    "(f / 'result.json').write_text(json.dumps({'key': key, 'figures': figures}))"
)
CRASH = "import os, sys; print('first', file=sys.stderr); print('out of luck', file=sys.stderr); os._exit(3)"
KILLED = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
ENDLESS = "import time; time.sleep(60)"


class Starter:
    """Starts the script given for a cell's name and counts how often."""

    def __init__(self, **scripts):
        self.scripts = scripts
        self.started = []

    def __call__(self, folder, log):
        name = json.loads((folder / "case.json").read_text())["cell"]["name"]
        self.started.append(name)
        command = [sys.executable, "-S", "-c", self.scripts.get(name, GOOD), str(folder)]
        return subprocess.Popen(command, stdout=log, stderr=log, text=True)


def run(tmp_path, names, starter, commit="abc", jobs=2, timeout_s=60.0, **settings):
    cells = [Cell(name, 0) for name in names]
    local = Local(jobs, Limits(timeout_s), start=starter)
    return judge(cells, JudgeSettings(**settings), tmp_path, lambda _: None, commit, local)


def test_crash_kill_and_time_out_are_rows_and_the_rest_goes_on(tmp_path):
    scripts = {"none/crash": CRASH, "desk/killed": KILLED, "flight/endless": ENDLESS}
    (endless,) = run(tmp_path, ["flight/endless"], Starter(**scripts), timeout_s=1.0)["rows"]
    assert endless["error"] == "took longer than 1 s"
    record = run(tmp_path, ["none/crash", "flight/good", "desk/killed", "wood", "desk"], Starter(**scripts), jobs=5)
    assert [(row["cell"], row["error"]) for row in record["rows"]] == [
        ("desk", ""),
        ("desk/killed", "killed by signal 9"),
        ("wood", ""),
        ("flight/good", ""),
        ("none/crash", "out of luck (exit code 3)"),
    ], "variants follow their recording, simulations come last"
    assert record["rows"][0]["figures"]["ate_m"] == 0.01


def test_what_is_done_is_not_done_again(tmp_path):
    starter = Starter(crash=CRASH)
    run(tmp_path, ["a", "crash"], starter)
    record = run(tmp_path, ["a", "crash", "b"], starter)
    assert starter.started == ["a", "crash", "crash", "b"], "only what has a result is left alone"
    assert [row["cell"] for row in record["rows"]] == ["a", "b", "crash"]
    (tmp_path / "judge.json").write_text(json.dumps(record))
    (tmp_path / "judge.md").touch()
    record = run(tmp_path, ["b"], starter)
    assert len(starter.started) == 4 and [row["cell"] for row in record["rows"]] == ["a", "b"], "what is there, too"
    assert [row["cell"] for row in run(tmp_path, ["b"], starter, commit="def")["rows"]] == ["b"]
    (tmp_path / "cells" / "a-s0" / "result.json").write_text('{"key": ')
    run(tmp_path, ["a"], starter)
    assert starter.started[4:] == ["b", "a"], "half of a result is none"


@pytest.mark.parametrize("change", [{"commit": "def"}, {"overrides": ("flow.enabled=false",)}, {"max_frames": 5}])
def test_other_code_or_settings_start_anew(tmp_path, change):
    starter = Starter()
    run(tmp_path, ["a"], starter)
    run(tmp_path, ["a"], starter, **change)
    assert starter.started == ["a", "a"]


def test_interrupted_judge_leaves_no_process(tmp_path):
    started = []

    def start(folder, log):
        started.append(Starter(a=ENDLESS)(folder, log))
        if len(started) == 2:
            raise KeyboardInterrupt
        return started[-1]

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path, ["a", "b"], start)
    assert started[0].poll() is not None
    started[1].wait()


def doubled(case, folder):
    """What a case's process calls."""
    if case["value"] < 0:
        raise EvaluationError("a negative\nvalue")
    (folder / "seen").touch()
    return {"value": 2 * case["value"]}


@pytest.mark.parametrize(("value", "code", "found"), [(3, 0, 6), (-1, 1, None)])
def test_a_process_stores_what_the_named_function_returns_or_says_why_not(tmp_path, capsys, value, code, found):
    task = Task(tmp_path, "case", f"{__name__}:doubled", {"value": value}, {"beside": 1})
    assert runner.main(task.prepare()) == code
    result = task.result()
    assert (None if result is None else result["value"]) == found
    assert capsys.readouterr().err == ("" if found else "a negative value\n")
    assert Task(tmp_path, "case", f"{__name__}:doubled", {"value": value + 1}).result() is None


@pytest.mark.parametrize("name", ["judge.json", "judge.md", "cells/good-s0/case.json", "commands/mine.txt", "rgb.txt"])
def test_a_judge_writes_into_no_folder_of_others(tmp_path, name):
    (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / name).write_text("precious")
    with pytest.raises(OutputError):
        run(tmp_path, ["good"], starter := Starter())
    assert starter.started == []
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [tmp_path / name]
    assert (tmp_path / name).read_text() == "precious"
