"""A planner's record is exact, survives a crash, and replays in a new planner."""

import base64
import json
import math
import zlib
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from edgeslam_torch.cli import main
from edgeslam_torch.errors import OutputError, SourceError
from edgeslam_torch.flying.flight_controller import FlightController
from edgeslam_torch.flying.recorder import EXITS, Recorder
from edgeslam_torch.flying.replay import replay, summary
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.drone_state import HOVER, Contact, DroneState, View
from edgeslam_torch.navigation.flight_record import PLAN, Decision, NewSkill, PlanLog, _encoded, read_plan
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.navigation.skills.explore import Explore
from edgeslam_torch.navigation.skills.follow_corridor import FollowCorridor
from edgeslam_torch.navigation.skills.go_to import GoTo
from edgeslam_torch.navigation.skills.return_home import ReturnHome

TICK_S = 0.1


def state(now_s, p, v=(0.0, 0.0, 0.0), yaw=0.0):
    """An open floor of 3 m, seen five times a second."""
    T = camera_on_body()
    turn = np.eye(4)
    turn[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    turn[:3, 3] = p
    depth = np.full((30, 40), 3.0, np.float32)
    K = np.array([[38.5, 0.0, 19.5], [0.0, 38.5, 14.5], [0.0, 0.0, 1.0]])
    view = View(now_s, depth, np.full_like(depth, 0.02), K, turn @ T) if round(now_s / TICK_S) % 2 == 0 else None
    return DroneState(now_s, np.array(p), yaw, np.array(v), view=view)


def fly(path, seconds, held_x=math.inf):
    """Record of a drone that follows every command until an invisible pane stops it."""
    log = PlanLog(path / PLAN, NavLimits())
    flight_controller = FlightController(NavLimits(), witness=log.add)
    flight_controller.begin(GoTo(np.array([1.5, 0.2, 1.15])))
    p, v, yaw, decisions = np.array([0.0, 0.0, 0.9]), np.zeros(3), 0.0, []
    for k in range(round(seconds / TICK_S)):
        decisions.append(flight_controller.plan(state(k * TICK_S, p, v, yaw)))
        w, (c, s) = decisions[-1].command, (math.cos(yaw), math.sin(yaw))
        v = np.array([c * w.forward_m_s - s * w.left_m_s, s * w.forward_m_s + c * w.left_m_s, w.up_m_s])
        if p[0] + TICK_S * v[0] > held_x:
            v = np.zeros(3)
        p, yaw = p + TICK_S * v, yaw + TICK_S * w.turn_left_rad_s
        if math.isfinite(held_x):
            flight_controller.order(state(k * TICK_S, p, v, yaw))
    log.close()
    return decisions


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Folder and decisions of a flight that gets under way."""
    folder = tmp_path_factory.mktemp("flight")
    decisions = fly(folder, 11.0)
    assert any(d.phase == "flying" and d.command.forward_m_s > 0.3 for d in decisions)
    return folder, decisions


def test_entries_come_back_to_the_last_bit(tmp_path):
    limits = NavLimits(speed_m_s=1.0 / 3.0)
    seen = replace(state(0.2, (0.1, 1.0 / 3.0, 1.2)), seen_s=math.nan, revision=2, metric=False)
    entries = [
        NewSkill(GoTo(np.array([1.0, -2.0, 1.15]))),
        NewSkill(Explore(until_s=math.inf)),
        NewSkill(ReturnHome(np.zeros((0, 2)))),
        NewSkill(FollowCorridor(until_s=7.5)),
        seen,
        Decision(HOVER, "flying"),
    ]
    log = PlanLog(tmp_path / PLAN, limits)
    for entry in entries:
        log.add(entry)
    log.close()
    first, goto, explore, home, follow, back, decision = read_plan(tmp_path / PLAN)
    assert first == limits and decision == entries[-1] and explore.skill.until_s == math.inf
    assert follow.skill.until_s == 7.5
    assert goto.skill.goal_w.tolist() == [1.0, -2.0, 1.15] and home.skill.track_w.shape == (0, 2)
    assert (back.p_w == seen.p_w).all() and math.isnan(back.seen_s) and back.revision == 2 and back.metric is False
    assert back.view.depth_m.dtype == np.float32 and (back.view.depth_m == seen.view.depth_m).all()
    assert (back.view.T_w_c == seen.view.T_w_c).all() and (back.view.K == seen.view.K).all()


def test_the_same_planner_decides_the_same(flight):
    folder, decisions = flight
    found = replay(folder)
    assert [step.now for step in found.steps] == decisions
    assert not found.differing and found.skills == ("GoTo",)


def test_what_was_felt_and_not_seen_turns_it_away_and_is_replayed(tmp_path):
    decisions = fly(tmp_path, 15.0, held_x=0.6)
    entries = list(read_plan(tmp_path / PLAN))
    touches = [k for k, entry in enumerate(entries) if isinstance(entry, Contact)]
    assert touches and entries[touches[0]].p_w[0] == pytest.approx(0.6, abs=0.05)
    assert entries[touches[0]].towards_w[0] > 0.7
    before, after = (next(e for e in entries[touches[0] + s :: s] if isinstance(e, Decision)) for s in (-1, 1))
    assert before.command.forward_m_s > 0.2 and after.command.forward_m_s < 0.05
    assert [step.now for step in replay(tmp_path).steps] == decisions


def test_another_speed_decides_otherwise(flight):
    slower = replay(flight[0], speed_m_s=0.2)
    assert slower.differing and not slower.differing[0].same
    assert max(step.now.command.forward_m_s for step in slower.steps) < 0.3
    assert max(step.before.command.forward_m_s for step in slower.steps) > 0.3
    assert any("first difference" in line for line in summary(slower))


def test_what_a_planner_hung_on_is_in_the_file(tmp_path):
    log = PlanLog(tmp_path / PLAN, NavLimits())
    flight_controller = FlightController(NavLimits(), witness=log.add)
    flight_controller.plan(state(0.0, (0.0, 0.0, 0.9)))

    def hangs(seen):
        raise KeyboardInterrupt

    flight_controller.pilot = type("Hung", (), {"update": staticmethod(hangs)})()
    with pytest.raises(KeyboardInterrupt):
        flight_controller.plan(state(0.1, (0.0, 0.0, 0.9)))
    log.close()
    found = replay(tmp_path)
    assert [step.before is None for step in found.steps] == [False, True]
    assert "no answer" in "\n".join(summary(found))


def test_a_file_that_a_crash_cut_off_is_good_up_to_there(tmp_path):
    decisions = fly(tmp_path, 5.0)
    data = (tmp_path / PLAN).read_bytes()
    (tmp_path / PLAN).write_bytes(data[:-7])
    found = replay(tmp_path)
    assert [step.now for step in found.steps] == decisions
    assert found.steps[-1].before is None


@cache
def _bomb():
    return base64.b64encode(zlib.compress(bytes(100_000_000))).decode()


def _array(shape):
    """A line whose array unpacks to 100 MB, whatever its shape."""
    return (json.dumps({"dtype": "<f8", "shape": shape, "zlib": _bomb()}) + "\n").encode()


def _zeros():
    """A line of 70 kB with an array of 50 MB, as large as one may be."""
    zeros = np.zeros((5000, 10_000), np.uint8)
    return (json.dumps(_encoded(NewSkill(ReturnHome(zeros)))) + "\n").encode()


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda lines: [lines[0], lines[1], b"{half a line\n", *lines[2:]], "line 3 is damaged"),
        (lambda lines: [b'{"format": "soup"}\n', *lines[1:]], "not a planner's record"),
        (lambda lines: [lines[0].replace(b"3", b"9"), *lines[1:]], "version 9 is not supported"),
        (lambda lines: [lines[0], b'{"kind": "os:system"}\n'], "os:system is unknown"),
        (lambda lines: [lines[0], b'{"kind": "edgeslam_torch.config:SlamConfig"}\n'], "SlamConfig is unknown"),
        (lambda lines: [lines[0], lines[1], lines[2].replace(b"GoTo", b"GoBy"), *lines[3:]], "GoBy is unknown"),
        (lambda lines: [lines[0], *lines[3:]], "does not begin with the flight's limits"),
        (lambda lines: [lines[0], _array(shape=[3])], "line 2 is damaged"),
        (lambda lines: [lines[0], _array(shape=[10**12])], "line 2 is damaged"),
        (lambda lines: [*lines[:2], *[_zeros()] * 40], "is damaged (an array of 50000000 bytes)"),
        (lambda lines: [lines[0], _array(shape=[-1])], "line 2 is damaged"),
        (lambda lines: [lines[0], b"[" * 100_000 + b"]" * 100_000 + b"\n"], "line 2 is damaged"),
        (lambda lines: lines[:2], "holds no state"),
        (lambda lines: [], "not a planner's record"),
    ],
)
def test_damaged_files_are_refused_in_words(damage, words, tmp_path, capsys):
    fly_short = PlanLog(tmp_path / PLAN, NavLimits())
    fly_short.add(NewSkill(GoTo(np.ones(3))))
    fly_short.add(state(0.0, (0.0, 0.0, 0.9)))
    fly_short.close()
    lines = (tmp_path / PLAN).read_bytes().splitlines(keepends=True)
    (tmp_path / PLAN).write_bytes(b"".join(damage(lines)))
    assert main(["fly", "replay", str(tmp_path)]) == 1
    assert words in capsys.readouterr().err


def test_replay_says_what_it_found_and_refuses_bad_limits(tmp_path, capsys):
    fly(tmp_path, 4.0)
    assert main(["fly", "replay", str(tmp_path)]) == 0
    assert "the same: 40 of 40" in capsys.readouterr().out
    assert main(["fly", "replay", str(tmp_path), "--speed", "7"]) == 1
    assert "speed 0.05 to 1" in capsys.readouterr().err
    assert main(["fly", "replay", str(tmp_path / "none")]) == 1
    assert "--record DIR" in capsys.readouterr().err


def test_a_skill_that_no_file_can_hold_is_said(tmp_path):
    log = PlanLog(tmp_path / PLAN, NavLimits())
    with pytest.raises(OutputError, match="cannot hold a set"):
        log.add(NewSkill(GoTo({1})))
    log.close()
    with pytest.raises(SourceError, match="holds no state"):
        replay(tmp_path)


def test_exits_are_recorded_as_they_become_known(tmp_path):
    recorder = Recorder(tmp_path / "flight", NavLimits())
    recorder.begin(PRESETS["tello"])
    flight_controller = FlightController(NavLimits(), [recorder.moment])
    flight_controller.order(state(0.0, (0.0, 0.0, 1.1)))
    assert not (tmp_path / "flight" / EXITS).exists()
    ahead = np.array([1.0, 0.0, 0.0])
    flight_controller.pilot.exits.exits = (Exit(np.array([2.0, 0.5, 1.1]), ahead, 0.9, 0.05, 0.1, 3),)
    flight_controller.order(state(0.1, (0.0, 0.0, 1.1)))
    recorder.close()
    assert recorder.failure is None
    lines = (tmp_path / "flight" / EXITS).read_text().splitlines()
    assert lines[0].startswith("x_m,y_m") and lines[1:] == ["2.000,0.500,1.000,0.000,0.900,0.050,0.100,3"]
