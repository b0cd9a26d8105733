"""Archives unpacked as if their authors were hostile: nothing leaves the folder, no links, a bounded size."""

import errno
import lzma
import shutil
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any, cast

from edgeslam_torch.errors import SourceError

MAX_FILES = 200_000
"""Of one archive; EuRoC's longest sequence has 15 000."""
MAX_GROWTH = 20
"""Unpacked size over the archive's; recordings of PNG images grow by less than 1.1, their lists by 5."""
_JUNK = ("__MACOSX", ".DS_Store", "Thumbs.db")
_NOT_IN_NAMES = frozenset("\\:\0")
"""Separators and drives of other systems."""
_DAMAGED = (
    *(zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, struct.error, EOFError),
    *(RuntimeError, NotImplementedError, ValueError, LookupError, OverflowError),
)
"""What Python's archives raise for bytes that are none; names that are no text are a `ValueError`."""
_DAMAGED_ERRNO = (None, errno.ENAMETOOLONG, errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.EINVAL, errno.EILSEQ)
"""Of an `OSError` that the archive is to blame for: gzip and bzip2 state none; names that no folder can hold."""
MAX_TAR_HEADER_BYTES = 1 << 20
"""Of one extended header, which `tarfile` reads whole."""
_ARCHIVES = (".zip", ".tgz", ".tar.gz", ".tar")


@dataclass(frozen=True, slots=True)
class _Member:
    """A regular file in an archive."""

    parts: tuple[str, ...]
    size: int
    handle: Any
    """The archive's own record of it."""


def unpack(archive: Path, inside: str, folder: Path) -> int:
    """Unpack a part of an archive into an empty folder.

    Args:
        archive: ``.zip``, ``.tgz``, ``.tar.gz`` or ``.tar``.
        inside: A folder in it, whose own name is left out, or an archive in it; everything when empty. An archive
            inside is unpacked in turn; one folder that holds everything is left out.
        folder: Where to.

    Returns:
        Number of files.

    Raises:
        SourceError: If it is damaged, hostile, or has no such part.
        OSError: If the disk is full.
    """
    if not inside.endswith(_ARCHIVES):
        return _unpack(archive, inside, folder)
    nested = folder.with_name(f"{folder.name}.{PurePosixPath(inside).name}")
    try:
        nested.unlink(missing_ok=True)
        with _opened(archive) as (members, read):
            member = next((m for m in members if "/".join(m.parts) == inside), None)
            if member is None:
                raise SourceError(f"{archive}: has no {inside}")
            _copy(read(member), nested, member.size, archive)
        return _unpack(nested, "", folder)
    finally:
        nested.unlink(missing_ok=True)


def member_ending(archive: Path, ending: str) -> bytes:
    """Content of the only file whose path ends so.

    Raises:
        SourceError: If the archive is damaged, or has none or several.
    """
    wanted = PurePosixPath(ending).parts
    with _opened(archive) as (members, read):
        found = [m for m in members if m.parts[-len(wanted) :] == wanted]
        if len(found) != 1:
            raise SourceError(f"{archive}: has {len(found)} files {ending}, not one")
        if found[0].size > 64 << 20:
            raise SourceError(f"{archive}: {ending} has {found[0].size} bytes")
        return read(found[0]).read()


def _unpack(archive: Path, inside: str, folder: Path) -> int:
    with _opened(archive) as (members, read):
        prefix = PurePosixPath(inside).parts if inside else _common_folder(members)
        chosen = [m for m in members if m.parts[: len(prefix)] == prefix and len(m.parts) > len(prefix)]
        if not chosen:
            raise SourceError(f"{archive}: has no {inside or 'files'}")
        made: set[Path] = set()
        for member in chosen:
            target = folder.joinpath(*member.parts[len(prefix) :])
            if target in made:
                raise SourceError(f"{archive}: has {'/'.join(member.parts)} twice")
            made.add(target)
            target.parent.mkdir(parents=True, exist_ok=True)
            _copy(read(member), target, member.size, archive)
    return len(chosen)


def _common_folder(members: list[_Member]) -> tuple[str, ...]:
    """The folder that holds everything, if there is one."""
    first = {m.parts[0] for m in members}
    return (first.pop(),) if len(first) == 1 and all(len(m.parts) > 1 for m in members) else ()


def _copy(source: IO[bytes], target: Path, size: int, archive: Path) -> None:
    """Copy no more than the size stated before: what the limits were checked with."""
    with source, target.open("xb") as file:
        left = size
        while left and (chunk := source.read(min(left, 1 << 20))):
            file.write(chunk)
            left -= len(chunk)
        if left or source.read(1):
            raise SourceError(f"{archive}: damaged: {target.name} has not the length that its header states")


class _TarInfo(tarfile.TarInfo):
    """Refuses extended headers of any length."""

    def _proc_member(self, archive: tarfile.TarFile) -> tarfile.TarInfo:
        kinds = (tarfile.XHDTYPE, tarfile.XGLTYPE, tarfile.SOLARIS_XHDTYPE)
        if self.type in (*kinds, tarfile.GNUTYPE_LONGNAME, tarfile.GNUTYPE_LONGLINK) and (
            self.size > MAX_TAR_HEADER_BYTES
        ):
            raise tarfile.ReadError(f"a header of {self.size} bytes")
        return super()._proc_member(archive)  # type: ignore[misc]


@contextmanager
def _opened(archive: Path) -> Iterator[tuple[list[_Member], Callable[[_Member], IO[bytes]]]]:
    """Checked members of an archive, and how to read them."""
    try:
        if zipfile.is_zipfile(archive):
            with zipfile.ZipFile(archive) as zipped:  # kind 8: a regular file, 10: a symbolic link
                members = [
                    _member(archive, info.filename, info.external_attr >> 28 in (0, 8), info.file_size, info)
                    for info in zipped.infolist()
                    if not info.is_dir()
                ]
                yield _checked(archive, members), lambda member: zipped.open(member.handle)
        else:
            with tarfile.open(archive, tarinfo=_TarInfo) as tar:
                inside = (info for info in tar if not info.isdir())
                files = _checked(archive, (_member(archive, i.name, i.isreg(), i.size, i) for i in inside))
                while tar.fileobj is not None and tar.fileobj.read(1 << 20):
                    pass  # to the end of the stream, where the checksum of the whole is
                yield files, lambda member: cast(IO[bytes], tar.extractfile(member.handle))
    except (*_DAMAGED, OSError) as error:
        if isinstance(error, OSError) and error.errno not in _DAMAGED_ERRNO:
            raise
        raise SourceError(f"{archive}: damaged, or no archive ({' '.join(str(error).split())[:120]})") from error


def _member(archive: Path, name: str, is_file: bool, size: int, handle: Any) -> _Member:
    if not is_file:
        raise SourceError(f"{archive}: {name[:80]!r} is a link or a device; nothing was unpacked")
    return _Member(_parts(archive, name), size, handle)


def _parts(archive: Path, name: str) -> tuple[str, ...]:
    """Folders and name of a member, which must lie below the place it is unpacked to."""
    parts = tuple(part for part in name.split("/") if part not in ("", "."))
    bad = name.startswith("/") or not parts or any(part == ".." or set(part) & _NOT_IN_NAMES for part in parts)
    if bad:
        raise SourceError(f"{archive}: {name[:80]!r} would lie outside the folder; nothing was unpacked")
    return parts


def _checked(archive: Path, members: Iterable[_Member]) -> list[_Member]:
    """The files, if they are no more than a recording has; the others of a bomb are not looked at."""
    files: list[_Member] = []
    size, most = 0, MAX_GROWTH * archive.stat().st_size + (16 << 20)
    for member in members:
        size += member.size
        if not any(part in _JUNK for part in member.parts):
            files.append(member)
        if len(files) > MAX_FILES or size > most:
            raise SourceError(
                f"{archive}: would unpack to {len(files)} files of {size / 1e9:.1f} GB or more; "
                "too much for a recording"
            )
    if size > shutil.disk_usage(archive.parent).free:
        raise OSError(28, f"{size / 1e9:.1f} GB do not fit on the disk", str(archive.parent))
    return files
