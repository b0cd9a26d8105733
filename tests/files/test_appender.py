import errno

import pytest
from full_disk import FullDisk

from edgeslam_torch.files.appender import Appender


def test_a_line_that_does_not_fit_is_taken_back(tmp_path, monkeypatch):
    path, disk = tmp_path / "lines", FullDisk(monkeypatch, "lines")
    lines = Appender(path, "# header\n")
    lines.write("one\n")
    disk.room = 10
    with pytest.raises(OSError) as caught:
        lines.write("a line of more than ten bytes\n")
    assert caught.value.errno == errno.ENOSPC
    assert path.read_text() == "# header\none\n"
    disk.room = None
    lines.write("two\n")
    lines.close()
    assert path.read_text() == "# header\none\ntwo\n"


def test_without_a_header_what_is_there_is_kept(tmp_path):
    path = tmp_path / "lines"
    path.write_text("old\n")
    lines = Appender(path, None)
    lines.write("new\n")
    lines.close()
    assert path.read_text() == "old\nnew\n"
    Appender(path, "# header\n").close()
    assert path.read_text() == "# header\n"
