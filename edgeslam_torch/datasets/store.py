"""Recordings fetched into a folder: archives by downloads that go on, unpacked whole or not at all."""

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgeslam_torch.datasets.catalogue import Archive, Recording
from edgeslam_torch.datasets.prepare import PREPARED, check_recording
from edgeslam_torch.datasets.unpack import member_ending, unpack
from edgeslam_torch.errors import OutputError, SourceError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.download import DownloadError, Progress, discard, fetch_any, remember, remembered
from edgeslam_torch.files.plain import subfolder

DOWNLOADS = ".downloads"
"""Folder of archives beside the recordings: parts, checksums, and archives that are kept."""
ORIGIN = ".origin.json"
"""In a recording's folder: where it came from. Written last, so it marks what is whole."""
MAX_ARCHIVE_BYTES = 40 << 30
"""Of an archive whose size is not known; the largest known one has 13 GB."""
_UNPACKED = 1.15
"""Space for an unpacked recording over its archive's size: PNG images hardly shrink, lists and poses are small."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Where a fetched archive came from, and how far it is verified."""

    url: str
    sha256: str
    verified: str
    """In words."""


def is_there(recording: Recording, root: Path) -> bool:
    """Whether a recording was fetched, whole."""
    return (root / recording.name / ORIGIN).is_file()


def missing(recordings: Sequence[Recording], root: Path) -> list[Recording]:
    """Those that are not there yet.

    Raises:
        OutputError: If the folder of one holds something that was not fetched by us.
    """
    for recording in recordings:
        folder = root / recording.name
        if folder.exists() and not is_there(recording, root):
            raise OutputError(f"{folder}: was not fetched by 'edgeslam data get'; move it away, or give another --to")
    return [recording for recording in recordings if not is_there(recording, root)]


def needed_bytes(recordings: Sequence[Recording], root: Path) -> int:
    """Disk space that fetching takes at its largest; archives of unknown size count nothing."""
    sizes = {recording.archive.file: recording.archive.size for recording in recordings}
    unpacked = sum(_UNPACKED * r.archive.size / r.archive.sequences * (1 + is_nested(r)) for r in recordings)
    there = sum(p.stat().st_size for p in (root / DOWNLOADS).glob("*") if p.is_file()) if root.is_dir() else 0
    return max(0, int(sum(sizes.values()) + unpacked) - there)


def is_nested(recording: Recording) -> bool:
    """Whether it is an archive inside an archive, which lies on the disk too while it is unpacked."""
    return recording.inside.endswith(".zip")


def check_space(recordings: Sequence[Recording], root: Path) -> None:
    """Refuse, before the first byte, a download that does not fit on the disk.

    Raises:
        OutputError: If there is not enough.
    """
    place = next(p for p in (root.absolute(), *root.absolute().parents) if p.exists())
    need, free = needed_bytes(recordings, root), shutil.disk_usage(place).free
    if need > free:
        raise OutputError(f"{root}: needs {need / 1e9:.1f} GB while unpacking, the disk has {free / 1e9:.1f} GB free")


def get(
    recordings: Sequence[Recording],
    root: Path,
    progress: Callable[[str], Progress],
    say: Callable[[str], None],
    given: Path | None = None,
    keep: bool = False,
) -> None:
    """Fetch and unpack recordings; each appears whole in its folder, an archive of several is fetched once.

    Args:
        recordings: Of `missing`.
        root: Folder of all recordings.
        progress: Makes the progress of a file's download from its name.
        say: Receives a line for every archive and recording.
        given: An archive that was downloaded by hand, used instead of the address.
        keep: Keep archives.

    Raises:
        SourceError: If no address answers, the transfer breaks off, or the checksum differs.
        OutputError: If the disk is full, or the folder cannot be written to.
    """
    try:
        downloads = subfolder(root, DOWNLOADS)
        for archive in dict.fromkeys(recording.archive for recording in recordings):
            own = [recording for recording in recordings if recording.archive == archive]
            origin = _fetched(archive, downloads, progress, given)
            say(f"{archive.file}: sha256 {origin.sha256}, {origin.verified}")
            with _remembered_if_good(archive, downloads, origin, given):
                for recording in own:
                    _place(recording, given or downloads / archive.file, origin, root, progress)
                    say(str(root / recording.name))
            if not keep and given is None:
                (downloads / archive.file).unlink()
    except OSError as error:
        raise OutputError(f"{error.filename or root}: cannot be written ({error.strerror or error})") from error


def _fetched(archive: Archive, downloads: Path, progress: Callable[[str], Progress], given: Path | None) -> Origin:
    """The archive in ``downloads``, or the given one, verified."""
    target = downloads / archive.file
    before = remembered(target)
    expected = archive.checksum or (f"sha256:{before}" if before else None)
    if given is not None:
        found, url = _digest(given, "sha256"), str(given)
        _compare(given, expected)
    else:
        url = _download(archive, target, expected, progress(archive.file))
        found = _digest(target, "sha256")
    if archive.checksum:
        who = "its publisher states" if archive.checksum_by == "publisher" else "independent projects recorded"
        return Origin(url, found, f"the checksum that {who}")
    if before:
        return Origin(url, found, "the same as at the first download")
    how = "" if url.startswith("https:") or given is not None else ", and it came unencrypted"
    return Origin(url, found, f"trusted on first use: no checksum is known{how}; the next download must match")


@contextmanager
def _remembered_if_good(archive: Archive, downloads: Path, origin: Origin, given: Path | None) -> Iterator[None]:
    """Store an archive's checksum once its content is verified; otherwise remove the download.

    An error page, or half a file, must not be what the next download has to match.
    """
    target = downloads / archive.file
    known = bool(archive.checksum or remembered(target))
    try:
        yield
    except SourceError:
        if given is None and not known:
            target.unlink(missing_ok=True)
        raise
    remember(target, origin.sha256)


def _download(archive: Archive, target: Path, expected: str | None, progress: Progress) -> str:
    """Address that the archive came from; it is at ``target`` then, verified."""
    if target.is_file():  # kept, or left by an interruption
        with suppress(SourceError):
            _compare(target, expected)
            return archive.urls[0]
    size = archive.size if archive.is_exact else 0
    try:
        url, part = fetch_any(archive.urls, target, size or MAX_ARCHIVE_BYTES, progress, size)
    except DownloadError as error:
        raise SourceError(
            f"{archive.file}: download failed: {error}; the part received is kept; run the same command to resume. "
            "If the publisher has moved it, download it by hand and give --archive FILE"
        ) from error
    try:
        _compare(part, expected)
    except SourceError as error:
        discard(part)
        pinned = "" if archive.checksum else f"; if its publisher has replaced it, remove {target}.sha256"
        raise SourceError(f"{archive.file}: not the expected file; it was deleted ({error}){pinned}") from error
    part.replace(target)
    discard(part)
    return url


def _compare(path: Path, expected: str | None) -> None:
    if expected is None:
        return
    algorithm, _, digest = expected.partition(":")
    found = _digest(path, algorithm)
    if found != digest:
        raise SourceError(f"{path}: its {algorithm} is {found}, expected {digest}")


def _digest(path: Path, algorithm: str) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, algorithm).hexdigest()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from error


def _place(
    recording: Recording, archive: Path, origin: Origin, root: Path, progress: Callable[[str], Progress]
) -> None:
    """Unpack, complete and check a recording beside its place, then move it there."""
    part = root / DOWNLOADS / f"{recording.name.replace('/', '_')}.unpacking"
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir()
    try:
        unpack(archive, recording.inside, part)
        PREPARED[recording.collection.layout](part, _truth(recording, root / DOWNLOADS, progress))
        check_recording(part)
        write_text(part / ORIGIN, json.dumps(_origin_record(recording, origin), indent=1) + "\n")
        *collection, name = recording.name.split("/")
        target = subfolder(root, *collection) / name
        part.rename(target)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _truth(recording: Recording, downloads: Path, progress: Callable[[str], Progress]) -> bytes | None:
    """Content of the true poses' file from an archive of its own, if the recording has one."""
    if recording.truth is None:
        return None
    origin = _fetched(recording.truth, downloads, progress, None)
    with _remembered_if_good(recording.truth, downloads, origin, None):
        return member_ending(downloads / recording.truth.file, f"mono_gt/{Path(recording.inside).name}.txt")


def _origin_record(recording: Recording, origin: Origin) -> dict[str, Any]:
    collection = recording.collection
    return {
        "recording": recording.name,
        "collection": collection.name,
        "page": collection.page,
        "licence": collection.licence,
        "cite": collection.cite,
        "archive": recording.archive.file,
        "url": origin.url,
        "sha256": origin.sha256,
        "verified": origin.verified,
        "inside": recording.inside,
        "fetched": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }
