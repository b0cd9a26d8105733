"""Published recordings: list them, and fetch them from their authors."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from edgeslam_torch.help.options import EXIT_INTERRUPTED, say

_CHECKSUM = {"publisher": "checksum by its publisher", "agreed": "checksum recorded by independent projects"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="list|get")
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
    from edgeslam_torch.datasets.consent import fetch, recordings_folder

    if args.action == "list":
        _list(args.names, recordings_folder(args.to))
        return 0
    try:
        fetch(args.names, recordings_folder(args.to), args.agree, print, args.archive, args.keep_archives)
    except KeyboardInterrupt:
        say("interrupted; run the same command to resume")
        return EXIT_INTERRUPTED
    return 0


def _list(names: Sequence[str], root: Path) -> None:
    from edgeslam_torch.datasets.catalogue import catalogue, chosen
    from edgeslam_torch.datasets.consent import gigabytes
    from edgeslam_torch.datasets.store import is_there

    recordings, sets = catalogue()
    shown = chosen(names) if names else list(recordings.values())
    collection = None
    for recording in shown:
        if recording.collection != collection:
            collection = recording.collection
            print(f"{collection.name}: {collection.licence}; {collection.page}")
        archive = recording.archive
        notes = [gigabytes(archive.size)]
        notes += [f"of {archive.file}"] if archive.sequences > 1 else []
        notes += [_CHECKSUM[archive.checksum_by]] if archive.checksum else ["no checksum known"]
        notes += [f"address in doubt: {archive.doubt}"] if archive.doubt else []
        notes += ["is there"] if is_there(recording, root) else []
        print(f"    {recording.name}: {', '.join(notes)}")
    for name, members in () if names else sets.items():
        print(f"{name}: {', '.join(members)}")
    print("no checksum known: the first download is trusted and its SHA-256 kept; the next must match")
