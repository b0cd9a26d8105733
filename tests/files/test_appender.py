import errno

import pytest

from edgeslam_torch.files.appender import Appender


class Full:
    """A file whose disk has room for ten more bytes."""

    def __init__(self, file):
        self.file = file

    def write(self, data):
        return self.file.write(data[:10])

    def __getattr__(self, name):
        return getattr(self.file, name)


def test_a_line_that_does_not_fit_is_taken_back(tmp_path):
    path = tmp_path / "lines"
    lines = Appender(path, "# header\n")
    lines.write("one\n")
    whole, lines._file = lines._file, Full(lines._file)
    with pytest.raises(OSError) as caught:
        lines.write("a line of more than ten bytes\n")
    assert caught.value.errno == errno.ENOSPC
    assert path.read_text() == "# header\none\n"
    lines._file = whole
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
