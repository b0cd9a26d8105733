"""Nothing is written through a link that lies in a folder of somebody else."""

import os

import numpy as np
import pytest

from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.appender import Appender
from edgeslam_torch.files.atomic import partial_beside, remove_partials, write_atomically, write_text
from edgeslam_torch.files.plain import create, extend, subfolder, write_image, write_new
from edgeslam_torch.writers.own_folder import FolderLock

PICTURE = np.zeros((4, 4, 3), np.uint8)
REPLACING = {
    "write_text": lambda path: write_text(path, "ours"),
    "write_new": lambda path: write_new(path, b"ours"),
    "write_image": lambda path: write_image(path, PICTURE),
    "create": lambda path: create(path).close(),
    "Appender": lambda path: Appender(path, "# ours\n").close(),
}
KEEPING = {
    "extend": lambda path: extend(path).close(),
    "Appender": lambda path: Appender(path, None).write("ours\n"),
    "FolderLock": lambda path: FolderLock(path.parent),
}


@pytest.fixture
def theirs(tmp_path):
    path = tmp_path / "elsewhere" / "theirs.txt"
    path.parent.mkdir()
    path.write_text("theirs")
    (tmp_path / "folder").mkdir()
    return path


@pytest.mark.parametrize("link", [os.symlink, os.link])
@pytest.mark.parametrize("name", REPLACING)
def test_a_link_is_replaced_and_not_followed(theirs, name, link):
    path = theirs.parents[1] / "folder" / "a.png"
    link(theirs, path)
    REPLACING[name](path)
    assert theirs.read_text() == "theirs"
    assert not path.is_symlink()
    assert not path.samefile(theirs)
    path.unlink()
    path.symlink_to(theirs.with_name("nothing"))
    REPLACING[name](path)
    assert not theirs.with_name("nothing").exists()


@pytest.mark.parametrize("link", [os.symlink, os.link])
@pytest.mark.parametrize("name", KEEPING)
def test_what_goes_on_in_a_file_goes_on_in_no_link(theirs, name, link):
    path = theirs.parents[1] / "folder" / ".lock"
    link(theirs, path)
    with pytest.raises((OSError, OutputError)):
        KEEPING[name](path)
    assert theirs.read_text() == "theirs"


@pytest.mark.parametrize("name", [*REPLACING, *KEEPING])
def test_a_pipe_is_refused_and_does_not_hang(tmp_path, name):
    os.mkfifo(tmp_path / ".lock")
    with pytest.raises((OSError, OutputError)):
        (REPLACING | KEEPING)[name](tmp_path / ".lock")
    assert (tmp_path / ".lock").is_fifo()


def test_the_temporary_name_cannot_be_foreseen(tmp_path):
    seen = []
    for _ in range(2):
        write_atomically(tmp_path / ("a" * 250), lambda _: seen.append({p.name for p in tmp_path.glob(".*")}))
    assert len(seen[0] | seen[1]) == 2


def test_partial_files_of_killed_processes_alone_are_removed(tmp_path, monkeypatch):
    with monkeypatch.context() as killed:
        killed.setattr(os, "getpid", lambda: 1)
        partial_beside(tmp_path / "left.mcap").touch()
    mine = partial_beside(tmp_path / "run.mcap")
    mine.touch()
    (tmp_path / ".mine.part").write_text("of somebody else")
    remove_partials(tmp_path)
    assert {p.name for p in tmp_path.glob(".*")} == {".mine.part", mine.name}


def test_a_folder_of_ours_is_no_link(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "rgb").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(OSError, match="link"):
        subfolder(tmp_path, "rgb", "more")
    assert subfolder(tmp_path, "a", "b").is_dir()
    assert not any((tmp_path / "elsewhere").iterdir())


@pytest.mark.parametrize("text", ["", "process 1 on board since yesterday"])
def test_a_lock_of_a_killed_run_is_taken_and_one_of_another_program_stays(tmp_path, text):
    (tmp_path / ".lock").write_text(text)
    lock = FolderLock(tmp_path)
    assert (tmp_path / ".lock").read_text().startswith(f"process {os.getpid()} ")
    lock.release()
    assert not (tmp_path / ".lock").exists()
    (tmp_path / ".lock").write_text("of another program")
    with pytest.raises(OutputError, match="--out"):
        FolderLock(tmp_path)
    assert (tmp_path / ".lock").read_text() == "of another program"
