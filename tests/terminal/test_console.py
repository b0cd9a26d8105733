"""What commands print, on terminals and pipes that take it, and on those that do not."""

import errno
import io
import os
import subprocess
import sys

import pytest

from edgeslam_torch.terminal.console import Console, exit_code


class Broken(io.StringIO):
    """A stream whose disk is full, or whose reader is gone."""

    def __init__(self, number):
        super().__init__()
        self._number = number

    def write(self, text):
        raise OSError(self._number, os.strerror(self._number))


@pytest.mark.parametrize("hostile", ["\x1b]0;owned\x07", "\x9b2J", "a\x08b", "\u202egnp.exe", "\x1b[2J", "\x00"])
def test_control_characters_of_names_do_not_reach_the_terminal(hostile):
    stream = io.StringIO()
    Console(stream).write(f"left out: {hostile}.png\n")
    shown = stream.getvalue()
    assert shown.startswith("left out: ") and shown.endswith(".png\n")
    assert all(c.isprintable() or c == "\n" for c in shown)


def test_letters_that_a_terminal_lacks_are_replaced():
    stream = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    Console(stream).write("± 深\n")
    stream.flush()
    assert stream.buffer.getvalue() == b"\xb1 ?\n"


def test_what_cannot_be_printed_is_dropped_remembered_and_decides_the_exit_code():
    fine = Console(io.StringIO())
    gone, full, closed = (Console(Broken(n)) for n in (errno.EPIPE, errno.ENOSPC, errno.EIO))
    for stream in (gone, full, closed):
        for _ in range(3):
            stream.write("x")
        stream.flush()
        assert stream.error is not None
    assert exit_code(0, fine, fine) == 0 and exit_code(3, fine, fine) == 3
    assert exit_code(0, gone, fine) == 0, "head has seen enough"
    assert exit_code(0, fine, full) == 0, "messages are lost, results are not"
    assert exit_code(0, full, fine) == 1
    assert exit_code(0, fine, closed) == 129


@pytest.mark.parametrize(("redirect", "code"), [("> /dev/full", 1), ("| true", 0), ("2>&-", 0), (">&-", 0)])
def test_commands_end_in_order_whatever_takes_their_output(redirect, code):
    script = f"set -o pipefail; '{sys.executable}' -m edgeslam_torch.cli --help {redirect}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=False)
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr
    assert done.returncode == (0 if code == 0 else 1)
