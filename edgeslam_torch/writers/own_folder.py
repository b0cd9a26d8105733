"""Folders that a command may write into: without files of others, or of its own results; one run at a time.

Results are known by their content (`is_run`, `edgeslam_torch.files.record_files.is_record`), never by their names.
"""

import errno
import os
import socket
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.output_file import RECORDING
from edgeslam_torch.files.plain import open_plain, open_shared
from edgeslam_torch.files.record_files import is_record
from edgeslam_torch.readers.bags.bag import is_bag
from edgeslam_torch.readers.images import image_files
from edgeslam_torch.readers.layouts import layout_of
from edgeslam_torch.readers.video import SUFFIXES as VIDEOS

try:
    import fcntl
except ImportError:  # Windows: concurrent runs into one folder are not detected
    fcntl = None  # type: ignore[assignment]

STATUS = "status.csv"
SUMMARY = "summary.json"
_STATUS_BEGIN = b"index,stamp_s,status,"
"""Header of the status table in every version; written with the first frame."""
_SUMMARY_KEYS = frozenset({"version", "frames", "statuses"})
_FEW = 3
"""Fewer pictures of others are no recording."""
_LOCK = ".lock"
_NOT_PLAIN = (errno.ELOOP, errno.EINVAL, errno.EISDIR, errno.ENXIO)
"""What opening a link, a pipe, a folder or a socket gives."""
_HOLDER = "process "
"""Beginning of its text."""


def is_run(folder: Path) -> bool:
    """Whether a run wrote here, including older versions and killed runs."""
    try:
        with open_plain(folder / STATUS) as file:
            if file.readline(200).startswith(_STATUS_BEGIN):
                return True
    except OSError:
        pass
    return is_record(folder / SUMMARY, _SUMMARY_KEYS)


def check_free(
    folder: Path,
    outputs: Collection[str],
    is_ours: Callable[[Path], bool] = is_run,
    remedy: str = "give another folder to --out",
) -> None:
    """Check that results named ``outputs`` may be written to a folder.

    Files of other names are ignored: a log, notes, a flight in a subfolder.

    Args:
        folder: It may be missing.
        outputs: Names of files and folders.
        is_ours: Whether what a folder holds under these names may be replaced, since the same command wrote it.
        remedy: For the message.

    Raises:
        OutputError: If a result would replace a file that no run wrote, or would lie among the files of a recording.
    """
    if not folder.is_dir():
        return
    part = next((name for name in RECORDING if (folder / name).exists()), None)
    if part is None and not is_ours(folder):
        part = _foreign(folder, outputs)
    if part is not None:
        raise OutputError(f"{folder}: holds {part}, which no run wrote; {remedy}")


def check_pictures(folder: Path, is_ours: Callable[[Path], bool], remedy: str) -> None:
    """Check that pictures may be added to a folder, which may be missing.

    Args:
        folder: The folder.
        is_ours: Whether a picture in it is one of those that the same command writes.
        remedy: For the message.

    Raises:
        OutputError: If a reader would take them for pictures of a recording there.
    """

    def is_free(folder: Path) -> bool:
        return is_run(folder) or sum(not is_ours(path) for path in image_files(folder)) < _FEW

    check_free(folder, (), is_free, remedy)


def _foreign(folder: Path, outputs: Collection[str]) -> str | None:
    """A file that results would replace, or that marks a recording."""
    name = next((name for name in outputs if _is_there(folder / name)), None)
    if name is not None:
        return name
    others = (p for p in folder.iterdir() if p.suffix.lower() in VIDEOS or (p.is_file() and is_bag(p)))
    media = [*image_files(folder), *others]
    if media:
        return media[0].name
    return "a recording" if layout_of(folder) is not None else None


def _is_there(path: Path) -> bool:
    """Whether there is more than an empty folder."""
    return os.path.lexists(path) and not (path.is_dir() and not any(path.iterdir()))


class FolderLock:
    """A lock held by one process; released by the system when the process dies.

    The file names its holder. Without support for locks nothing is locked.
    """

    def __init__(self, folder: Path) -> None:
        """Take the lock.

        Raises:
            OutputError: If another run holds it.
            OSError: If the folder cannot be written to.
        """
        self._path = folder / _LOCK
        self._file = self._open()
        while not self._is_there():  # the previous run released it between opening and locking
            self._file.close()
            self._file = self._open()
        self._file.truncate(0)
        self._file.seek(0)
        since = time.strftime("%Y-%m-%d %H:%M:%S")
        self._file.write(f"{_HOLDER}{os.getpid()} on {socket.gethostname()} since {since}".encode())

    def release(self) -> None:
        """Release the lock; may be called repeatedly."""
        if not self._file.closed:
            with suppress(OSError):
                self._path.unlink()
            self._file.close()

    def _open(self) -> BinaryIO:
        folder = self._path.parent
        try:
            file = open_shared(self._path)
        except OSError as error:
            if error.errno in _NOT_PLAIN:
                raise OutputError(f"{folder}: {self._not_ours()}") from error
            raise
        holder = file.read(200).decode("utf-8", errors="replace")
        try:
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            holder = holder or "another process"
            raise OutputError(f"{folder}: {holder} writes a run there; give another folder to --out") from None
        except OSError:
            pass  # a file system without locks
        if holder and not holder.startswith(_HOLDER):
            file.close()
            raise OutputError(f"{folder}: {self._not_ours()}")
        return file

    def _not_ours(self) -> str:
        return f"holds {self._path.name}, which no run wrote; give another folder to --out"

    def _is_there(self) -> bool:
        try:
            return os.path.samestat(os.fstat(self._file.fileno()), self._path.stat())
        except FileNotFoundError:
            return False
