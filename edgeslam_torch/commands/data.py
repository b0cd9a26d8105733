"""Published recordings: list them, and fetch them from their authors."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.errors import ConfigError

if TYPE_CHECKING:
    from edgeslam_torch.datasets.catalogue import Collection, Recording
    from edgeslam_torch.files.download import Progress

EXIT_INTERRUPTED = 130
_CHECKSUM = {"publisher": "checksum by its publisher", "agreed": "checksum recorded by independent projects"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    actions = parser.add_subparsers(dest="action", required=True)
    listing = actions.add_parser("list", help="names, sizes, licences, and what is there")
    listing.add_argument("names", nargs="*", metavar="NAME", help="only these; patterns such as 'tum_fr1_*'")
    add_folder(listing, "--to")
    getting = actions.add_parser("get", help="fetch, verify and unpack")
    getting.add_argument(
        "names", nargs="+", metavar="NAME", help="as 'list' prints it, a pattern, or 'readme': what the README quotes"
    )
    add_folder(getting, "--to")
    add_agree(getting)
    getting.add_argument("--archive", type=Path, metavar="FILE", help="an archive that you downloaded yourself")
    getting.add_argument("--keep-archives", action="store_true", help="keep archives after unpacking")


def add_folder(parser: argparse.ArgumentParser, option: str) -> None:
    """Declare where recordings are."""
    parser.add_argument(option, type=Path, metavar="DIR", help="folder (default: EDGESLAM_DATA, else ./recordings)")


def add_agree(parser: argparse.ArgumentParser) -> None:
    """Declare the consent to licences."""
    parser.add_argument(
        "--agree", action="store_true", help="agree to the licences of the recordings, which are printed, unasked"
    )


def main(args: argparse.Namespace) -> int:
    """Run one of the two subcommands."""
    if args.action == "list":
        _list(args.names, recordings_folder(args.to))
        return 0
    try:
        fetch(args.names, recordings_folder(args.to), args.agree, args.archive, args.keep_archives)
    except KeyboardInterrupt:
        sys.stderr.write("edgeslam: interrupted; the same command goes on where it stopped\n")
        return EXIT_INTERRUPTED
    return 0


def recordings_folder(given: Path | None) -> Path:
    """Where recordings are: as given, ``EDGESLAM_DATA``, else ``recordings`` here."""
    return given or Path(os.environ.get("EDGESLAM_DATA") or "recordings")


def fetch(
    names: Sequence[str], root: Path, agree: bool, archive: Path | None = None, keep: bool = False
) -> "list[Recording]":
    """Fetch what is missing, once the user has agreed to the licences; all that the names stand for."""
    from edgeslam_torch.datasets.catalogue import chosen
    from edgeslam_torch.datasets.store import check_space, get, missing, needed_bytes

    recordings = chosen(names)
    wanted = missing(recordings, root)
    for recording in recordings:
        if recording not in wanted:
            print(f"{root / recording.name}: is there")
    if not wanted:
        return recordings
    if archive is not None and len({recording.archive for recording in wanted}) > 1:
        raise ConfigError(f"--archive {archive}: is for recordings of one archive, these have several")
    check_space(wanted, root)
    size = sum({recording.archive: recording.archive.size for recording in wanted}.values())
    print(f"to {root}: {len(wanted)} recording{'s'[: len(wanted) > 1]}, {_gigabytes(size)} to download, "
          f"{_gigabytes(needed_bytes(wanted, root))} of disk while unpacking")  # fmt: skip
    _ask({recording.collection: None for recording in wanted}, agree)
    with _Bars() as bars:
        get(wanted, root, bars.of, print, archive, keep)
    return recordings


def _list(names: Sequence[str], root: Path) -> None:
    from edgeslam_torch.datasets.catalogue import catalogue, chosen
    from edgeslam_torch.datasets.store import is_there

    recordings, sets = catalogue()
    shown = chosen(names) if names else list(recordings.values())
    collection = None
    for recording in shown:
        if recording.collection != collection:
            collection = recording.collection
            print(f"{collection.name}: {collection.licence}; {collection.page}")
        archive = recording.archive
        notes = [_gigabytes(archive.size)]
        notes += [f"of {archive.file}"] if recording.inside.endswith(".zip") or recording.truth else []
        notes += [_CHECKSUM[archive.checksum_by]] if archive.checksum else ["no checksum known"]
        notes += [f"address in doubt: {archive.doubt}"] if archive.doubt else []
        notes += ["is there"] if is_there(recording, root) else []
        print(f"    {recording.name}: {', '.join(notes)}")
    for name, members in () if names else sets.items():
        print(f"{name}: {', '.join(members)}")
    print("no checksum known: the first download is trusted and its SHA-256 kept; the next must match")


def _ask(collections: "dict[Collection, None]", agree: bool) -> None:
    """Show the licences, and go on only with consent.

    Raises:
        ConfigError: Without.
    """
    for collection in collections:
        print(f"{collection.name} is not ours. Licence: {collection.licence} ({collection.terms})")
        print(f"    its authors ask to cite: {collection.cite}")
    if agree:
        return
    if not sys.stdin.isatty():
        raise ConfigError("the licences above need your consent: give --agree")
    sys.stdout.write("Do you agree to these terms? [y/N] ")
    sys.stdout.flush()
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise ConfigError("nothing was fetched without your consent")


def _gigabytes(size: int) -> str:
    return f"{size / 1e9:.2f} GB" if size else "size not known"


class _Bars:
    """A bar for each download."""

    def __init__(self) -> None:
        self._close: list[Callable[[], None]] = []

    def __enter__(self) -> "_Bars":
        return self

    def __exit__(self, *_: object) -> None:
        for close in self._close:
            close()

    def of(self, name: str) -> "Progress":
        """The progress of one file."""
        from tqdm import tqdm

        bar = tqdm(unit="B", unit_scale=True, desc=name, disable=None)
        self._close.append(bar.close)

        def show(have: int, total: int) -> None:
            bar.total = total or None
            bar.update(have - bar.n)

        return show
