"""Files and folders where others may have left links and pipes: nothing outside is written to, nothing is waited for.

Every file of ours is opened for writing here or in `atomic`. A link at a file's name is replaced, never followed; what
is no plain file (a device, a pipe, a folder) is refused; a folder of ours within another may not be a link.
"""

import errno
import os
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

from edgeslam_torch.errors import EdgeSlamError

_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
_NO_WAIT = getattr(os, "O_NONBLOCK", 0)
"""A named pipe does not hold up whoever opens it."""
_COMMON = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0) | _NO_FOLLOW
_MODE = 0o666
"""The umask clears bits of it."""


def open_plain(path: Path) -> BinaryIO:
    """A file to read that lies in a folder of somebody else; the target of a link is read.

    Raises:
        OSError: If it cannot be opened or is no plain file, such as a named pipe, which would be waited for.
    """
    handle = os.open(path, os.O_RDONLY | _NO_WAIT | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0))
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(errno.EINVAL, "is not a regular file", str(path))
    return os.fdopen(handle, "rb")


def read_bounded(path: Path, max_bytes: int, error: type[EdgeSlamError], what: str) -> bytes:
    """Bytes of a plain file.

    Args:
        path: The file.
        max_bytes: Maximum size.
        error: Exception class to raise.
        what: What it should be, for the message on its size.

    Raises:
        EdgeSlamError: ``error``, in one line with the file's name, if it is missing, no plain file or too large.
    """
    try:
        with open_plain(path) as file:
            size = os.fstat(file.fileno()).st_size
            if size > max_bytes:
                raise error(f"{path}: {size / 1e6:.1f} MB is too large for {what}")
            return file.read()
    except OSError as reason:
        raise error(f"{path}: {reason.strerror or reason}") from reason
    except ValueError as reason:  # no name of a file
        raise error(f"{path}: {reason}") from reason


def check_replaceable(path: Path) -> None:
    """Check that nothing but a plain file or a link would be replaced at ``path``.

    Raises:
        OSError: If there is a folder, a device or a pipe.
    """
    try:
        kind = path.lstat().st_mode
    except FileNotFoundError:
        return
    if stat.S_ISDIR(kind):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not (stat.S_ISREG(kind) or stat.S_ISLNK(kind)):
        raise OSError(errno.EINVAL, "is not a regular file", str(path))


def create(path: Path) -> BinaryIO:
    """A new unbuffered file for writing, in place of what ``path`` was; the target of a link stays as it is.

    Raises:
        OSError: If it cannot be made.
    """
    check_replaceable(path)
    path.unlink(missing_ok=True)
    return open_exclusively(path)


def open_exclusively(path: Path) -> BinaryIO:
    """A new unbuffered file for writing.

    Raises:
        OSError: If there is anything at ``path`` already, or it cannot be made.
    """
    return _raw(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | _COMMON, _MODE), "wb")


def extend(path: Path) -> BinaryIO:
    """An unbuffered file to append to; made when missing.

    Raises:
        OSError: If it is a link, or no plain file of one name.
    """
    return _raw(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | _NO_WAIT | _COMMON, _MODE), "ab", path)


def open_shared(path: Path) -> BinaryIO:
    """An unbuffered file to read and write; made when missing, what it holds stays.

    Raises:
        OSError: If it is a link, or no plain file of one name.
    """
    return _raw(os.open(path, os.O_RDWR | os.O_CREAT | _NO_WAIT | _COMMON, _MODE), "r+b", path)


def write_new(path: Path, data: bytes) -> None:
    """Write a file at once, without waiting for the disk: pictures, of which there are many."""
    with create(path) as file:
        left = memoryview(data)
        while left:  # after a part, the next call says why not all fits
            written = file.write(left)
            if not written:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
            left = left[written:]


def write_image(path: Path, image: Any, options: Sequence[int] = ()) -> None:
    """Write a picture in the format of its suffix, as `write_new`.

    Raises:
        OSError: If it cannot be encoded or written.
    """
    import cv2

    try:
        encoded, data = cv2.imencode(path.suffix, image, list(options))
    except cv2.error:
        encoded = False
    if not encoded:
        raise OSError(errno.EINVAL, f"OpenCV cannot encode it as {path.suffix or 'a picture'}", str(path))
    write_new(path, data.tobytes())


def subfolder(folder: Path, *names: str) -> Path:
    """A folder of ours within another, made when missing; ``folder`` itself may be a link of the user's.

    Raises:
        OSError: If it cannot be made, or leads elsewhere.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        folder = folder / name
        folder.mkdir(exist_ok=True)
        if folder.is_symlink():
            raise OSError(errno.ELOOP, "is a link to another folder", str(folder))
    return folder


def _raw(handle: int, mode: str, checked: Path | None = None) -> Any:
    try:
        if checked is not None:
            state = os.fstat(handle)
            if not stat.S_ISREG(state.st_mode) or state.st_nlink > 1:
                raise OSError(errno.EINVAL, "is not a regular file, or has hard links", str(checked))
        return os.fdopen(handle, mode, buffering=0)
    except BaseException:
        os.close(handle)
        raise
