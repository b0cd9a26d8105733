"""The judge of flights."""

import json

import numpy as np
import pytest
from markdown_rows import row, rows

from edgeslam_torch.cli import main
from edgeslam_torch.errors import OutputError
from edgeslam_torch.eval.experiment.runner import Task
from edgeslam_torch.eval.judge.navigation import table
from edgeslam_torch.eval.judge.navigation.behaviours import BEHAVIOURS, corridor_ends, right_exits
from edgeslam_torch.eval.judge.navigation.flight import fly, shortest_m, true_layer
from edgeslam_torch.eval.judge.navigation.flown import Case, Flown
from edgeslam_torch.eval.judge.navigation.table import judge_flights, markdown
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.synthetic.sites.build import named_site


def test_the_oracle_flies_straight_where_nothing_is_in_the_way():
    site = named_site("blank_walls", 0)
    straight = float(np.linalg.norm(site.goal_w[:2]))
    assert straight - 0.1 <= shortest_m(site, NavLimits()) <= 1.09 * straight


def flown(reached, contacts=0, fault="none", **fields):
    ended = {"ended": "done" if reached else "crash", "landed": not contacts, "time_s": 20.0, "oracle_s": 16.0}
    return Flown(Case("blank_walls", 0, fault), reached, contacts=contacts, **(ended | fields))


def test_the_table_counts_and_says_how_sure_it_is():
    text = markdown([flown(True), flown(True), flown(False, 1)])
    assert rows(text)[1][4:7] == ["3", "2 (21 to 94 %)", "1 (6 to 79 %)"]
    assert row(text, "blank_walls")["time over oracle"] == "1.25" and "precision" not in text
    text = markdown([flown(True, exits=[2, 2, 1]), flown(True, exits=[1, 0, 0]), flown(True)])
    assert ["goto", "truth", "3", "2", "1 (9 to 91 %)", "1 (6 to 79 %)"] in rows(text)


def test_flights_are_kept_and_one_that_fails_ends_no_other(tmp_path, monkeypatch):
    """A world that does not exist is an error of that flight; what was flown before stays."""
    good, bad, said = Case("blank_walls", 0), Case("nowhere", 0), []
    track = {"track_w": [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]], "dangers": ("drift",)}
    result = {"flown": flown(True, **track).record()}
    monkeypatch.setattr(Task, "result", lambda task: result if task.name == good.name else None)
    flights = judge_flights([bad, good], tmp_path, 1, said.append)
    assert [f.reached for f in flights] == [False, True] and flights[1].case == good
    assert flights[0].ended.startswith("failed: ") and "nowhere" in flights[0].ended
    assert len(said) == 1 and "nowhere" in said[0]
    assert row((tmp_path / "navigation.md").read_text(), "nowhere")["reached"].startswith("0 ")
    assert len(judge_flights([good], tmp_path, 1, said.append)) == 1


def test_flights_are_not_judged_into_a_folder_of_others(tmp_path):
    (tmp_path / "navigation.md").write_text("precious")
    with pytest.raises(OutputError):
        judge_flights([], tmp_path, 1, print)
    assert (tmp_path / "navigation.md").read_text() == "precious"


def exit_at(true, aside=0.0, turned=0.0):
    c, s = np.cos(turned), np.sin(turned)
    normal = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ true.normal_w
    across = np.array([-true.normal_w[1], true.normal_w[0], 0.0])
    return Exit(true.centre_w + aside * across, normal, 0.9, 0.05, 0.05, 2)


def test_exits_are_right_within_half_a_metre_and_through_the_same_wall():
    site = named_site("doors", 0)
    first, second = site.exits
    assert right_exits([exit_at(first, 0.3), exit_at(second, -0.3, 0.3)], site) == 2
    assert right_exits([exit_at(first, 0.3), exit_at(first, -0.3)], site) == 1, "one exit counts once"
    assert right_exits([exit_at(first, turned=np.pi)], site) == 1, "seen from behind"
    assert right_exits([exit_at(first, 0.7), exit_at(second, turned=1.2)], site) == 0


def test_a_corridor_ends_at_its_door_or_in_its_arm():
    (door,) = corridor_ends(named_site("corridor", 0))
    assert door == pytest.approx(named_site("corridor", 0).exits[0].centre_w[:2])
    left, right = corridor_ends(named_site("t_corridor", 0))
    assert left[0] == right[0] and left[1] == -right[1] != 0
    with pytest.raises(ValueError, match="two_rooms"):
        corridor_ends(named_site("two_rooms", 0))


def test_what_counts_as_reached_is_the_behaviours():
    site = named_site("corridor", 0)
    at_the_door = [*(site.exits[0].centre_w[:2] - [0.8, 0.0]), 1.1]
    there = flown(True, distance_m=2.0, home_m=0.4, track_w=[[0.0, 0.0, 1.1], at_the_door])
    reached = {name: behaviour.reached(there, site) for name, behaviour in BEHAVIOURS.items()}
    assert reached == {"goto": False, "home": False, "corridor": True, "exits": False}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--behaviour", "dance"], "--behaviour: unknown name 'dance'"),
        (["--behaviour", "corridor", "--world", "two_rooms"], "none of two_rooms is a corridor"),
        (["--depth", "none", "--max-frames", "9"], "--max-frames, --depth: these options are of recordings"),
    ],
)
def test_flights_that_cannot_be_judged_are_refused(arguments, words, capsys):
    assert main(["bench", "--navigation", *arguments]) == 1
    assert words in capsys.readouterr().err


def test_options_of_flights_need_them(capsys):
    assert main(["bench", "--world", "corridor", "--first-seed", "3"]) == 1
    assert "--world, --first-seed: these options need --navigation" in capsys.readouterr().err


def test_the_flights_are_written_where_the_options_say(tmp_path, monkeypatch):
    flights = [Flown(Case("corridor", 3), reached=True, time_s=30.0)]
    monkeypatch.setattr(table, "judge_flights", lambda *_: flights)
    options = ["--json", tmp_path / "f.json", "--markdown", tmp_path / "f.md", "--out", tmp_path / "out"]
    assert main(["bench", "--navigation", *map(str, options)]) == 0
    assert [Flown.of_record(record) for record in json.loads((tmp_path / "f.json").read_text())] == flights
    assert "corridor" in (tmp_path / "f.md").read_text()


def test_true_free_space_is_that_of_the_solids():
    site = named_site("l_corridor", 0)
    layer = true_layer(site, NavLimits())
    for x, y in ((0.0, 0.0), (3.0, 0.0)):
        assert layer.free[tuple(layer.cells(np.array([x, y])))]
    assert layer.solid[tuple(layer.cells(np.array([2.0, 3.0])))]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("case", "true"),
    [
        (Case("blank_walls", 0), lambda f: f.clearance_min_m > 0.1 and f.landed and f.time_s < 2 * f.oracle_s),
        (Case("two_rooms", 1, behaviour="exits"), lambda f: f.home_m < 0.3 and f.exits == [1, 1, 1]),
        (Case("l_corridor", 1, behaviour="corridor"), lambda f: True),
        (Case("blank_walls", 0, "hung"), lambda f: f.landed and "planner" in " ".join(f.dangers)),
    ],
    ids=lambda case: getattr(case, "name", ""),
)
def test_by_the_true_pose_it_reaches_its_goal_without_contact_unless_its_planner_hangs(case, true):
    found = fly(case)
    assert found.reached == (case.fault == "none") and found.contacts == 0 and true(found), found
