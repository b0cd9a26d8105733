"""Download by name: disk space, licence, and the user's consent before the first byte."""

import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from edgeslam_torch.datasets.catalogue import Collection, Recording, chosen
from edgeslam_torch.datasets.store import check_space, get, missing, needed_bytes
from edgeslam_torch.errors import ConfigError
from edgeslam_torch.files.download import Progress as DownloadProgress
from edgeslam_torch.terminal.progress import Progress


def recordings_folder(given: Path | None) -> Path:
    """Where recordings are: as given, ``EDGESLAM_DATA``, else ``recordings`` here."""
    return given or Path(os.environ.get("EDGESLAM_DATA") or "recordings")


def fetch(
    names: Sequence[str],
    root: Path,
    agree: bool,
    say: Callable[[str], None],
    archive: Path | None = None,
    keep: bool = False,
) -> list[Recording]:
    """Fetch what is missing of the named recordings, once the user has agreed to their licences.

    Args:
        names: Names, patterns and sets.
        root: Folder of all recordings.
        agree: Whether the user has agreed before.
        say: Receives licences, sizes and results, line by line.
        archive: A download by hand.
        keep: Keep archives after unpacking.

    Returns:
        All recordings that the names stand for.

    Raises:
        EdgeSlamError: If a name stands for nothing, the user does not agree, or a recording cannot be had.
    """
    recordings = chosen(names)
    wanted = missing(recordings, root)
    for recording in recordings:
        if recording not in wanted:
            say(f"{root / recording.name}: is there")
    if not wanted:
        return recordings
    if archive is not None and len({recording.archive for recording in wanted}) > 1:
        raise ConfigError(f"--archive {archive}: is for recordings of one archive, these have several")
    check_space(wanted, root)
    size = sum({recording.archive: recording.archive.size for recording in wanted}.values())
    count = f"{len(wanted)} recording{'s' if len(wanted) > 1 else ''}"
    unpacked = gigabytes(needed_bytes(wanted, root))
    say(f"to {root}: {count}, {gigabytes(size)} to download, {unpacked} of disk while unpacking")
    _ask({recording.collection: None for recording in wanted}, agree, say)
    with Progress("downloading") as progress:

        def of(name: str) -> DownloadProgress:
            progress.phase(name, unit="MB")
            return progress.downloaded

        get(wanted, root, of, say, archive, keep)
    return recordings


def _ask(collections: dict[Collection, None], agree: bool, say: Callable[[str], None]) -> None:
    """Show the licences, and go on only with consent."""
    for collection in collections:
        say(f"{collection.name} is not ours. Licence: {collection.licence} ({collection.terms})")
        say(f"    its authors ask to cite: {collection.cite}")
    if agree:
        return
    if not sys.stdin.isatty():
        raise ConfigError("the licences above need your consent: give --agree")
    sys.stdout.write("Do you agree to these terms? [y/N] ")
    sys.stdout.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ConfigError("nothing was fetched without your consent")


def gigabytes(size: int) -> str:
    """A size in words."""
    return f"{size / 1e9:.2f} GB" if size else "size not known"
