"""``edgeslam fly``: nothing moves without --fly, and what is wrong is said before anything is asked of a drone."""

import os
import threading

import pytest

from edgeslam_torch.cli import main
from edgeslam_torch.flying.keys import listen


def test_a_dry_run_shows_the_plan_and_contacts_nobody(capsys):
    assert main(["fly", "goto", "3", "-4", "--dry-run", "--back", "--speed", "0.25"]) == 0
    out = capsys.readouterr().out
    assert "5.0 m in a straight line, at least 20 s" in out
    assert out.index("take off") < out.index("fly to (3, -4)") < out.index("return") < out.index("4. land")
    assert "nothing was sent" in out


@pytest.mark.parametrize(("verb", "words"), [("corridor", "until it ends or opens"), ("exit", "fly through it")])
def test_verbs_that_look_for_openings_say_so(verb, words, capsys):
    assert main(["fly", verb, "40", "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert words in out and "at most 40 s" in out


def test_without_leave_nothing_moves(capsys):
    assert main(["fly", "explore", "30", "--drone", "sim://blank_walls:1"]) == 0
    assert "nothing moved: add --fly" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["goto", "50", "0"], "fence is at 30.0 m"),
        (["goto", "3", "0", "5"], "flight height must be 0.5 to 1.9 m"),
        (["goto", "3", "0", "1", "--height", "1.2"], "given twice"),
        (["goto", "3", "0", "--speed", "3"], "--speed must be 0.05 to 1 m/s"),
        (["goto", "3", "0", "--fence", "-1"], "--fence must be positive"),
        (["goto", "3", "0", "--fly", "--dry-run"], "contradict"),
        (["explore", "0"], "above 0"),
        (["corridor", "0"], "above 0"),
        (["exit", "9999"], "below 3600"),
        (["home", "--drone", "sim://coridor"], "unknown world 'coridor'"),
        (["home", "--drone", "sim://corridor:x"], "not an integer"),
    ],
)
def test_what_is_wrong_is_said(arguments, words, capsys):
    assert main(["fly", *arguments]) == 1
    assert words in capsys.readouterr().err


def test_goals_that_are_no_numbers(capsys):
    with pytest.raises(SystemExit):
        main(["fly", "goto", "3", "nan"])
    assert "finite" in capsys.readouterr().err


def test_keys_hold_let_go_and_land():
    read, write = os.pipe()
    told = []
    os.write(write, b"x  l ")
    try:
        listen(read, threading.Event(), told.append, lambda: told.append("land"))
    finally:
        os.close(read)
        os.close(write)
    assert told == [True, False, "land"]
