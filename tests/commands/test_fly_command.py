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


def test_without_leave_nothing_moves(capsys):
    assert main(["fly", "explore", "3", "--drone", "sim://corridor:1"]) == 0
    assert "nothing moved: add --fly" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments",
    ["goto 50 0", "goto 3 0 5", "goto 3 0 1 --height 1.2", "goto 3 0 --speed 3", "goto 3 0 --fence -1",
     "goto 3 0 --fly --dry-run", "explore 0", "corridor 0", "exit 9999", "home --drone sim://coridor",
     "home --drone sim://corridor:x"],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(arguments, capsys):
    assert main(["fly", *arguments.split()]) == 1
    assert capsys.readouterr().err.count("error: ") == 1


def test_keys_hold_let_go_and_land():
    read, write = os.pipe()
    told = []
    os.write(write, b"x  lq")
    os.close(write)
    try:
        listen(read, threading.Event(), told.append, lambda: told.append("land"))
    finally:
        os.close(read)
    assert told == [True, False, "land", "land"], "one that was pressed on the ground does not count"
