"""Files are the old one or the new one, and readable by whom the umask says."""

import os
import stat

import pytest

from edgeslam_torch.files.atomic import write_atomically, write_text


@pytest.fixture
def group_readable():
    before = os.umask(0o027)
    yield
    os.umask(before)


def test_the_umask_decides_who_may_read(tmp_path, group_readable):
    write_text(tmp_path / "a", "x")
    assert stat.S_IMODE((tmp_path / "a").stat().st_mode) == 0o640


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    def fail(file):
        raise OSError("disk full")

    write_text(tmp_path / "a", "old")
    with pytest.raises(OSError, match="disk full"):
        write_atomically(tmp_path / "a", fail)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]
    assert (tmp_path / "a").read_text() == "old"
