"""``catalogue.toml`` as records, and what a name on the command line means."""

import difflib
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import urlsplit

from edgeslam_torch.errors import ConfigError

CATALOGUE = Path(__file__).with_name("catalogue.toml")


@dataclass(frozen=True, slots=True)
class Collection:
    """Recordings published together."""

    name: str
    page: str
    licence: str
    terms: str
    """Where the licence is."""
    cite: str
    layout: str
    """What is done after unpacking: a name in `prepare.PREPARED`."""


@dataclass(frozen=True, slots=True)
class Archive:
    """A published file."""

    file: str
    """Its name here."""
    urls: tuple[str, ...]
    """Tried in order."""
    size: int
    """Bytes; 0 when not known."""
    is_exact: bool
    """Whether the size is exact."""
    checksum: str
    """``sha256:...`` or ``md5:...``; empty when none is known."""
    checksum_by: str
    """``publisher``, or ``agreed`` by the records of independent projects."""
    doubt: str
    """What could not be confirmed about it."""
    sequences: int
    """Recordings in it."""


@dataclass(frozen=True, slots=True)
class Recording:
    """One sequence that can be fetched."""

    name: str
    """Of its folder, below that of all recordings."""
    collection: Collection
    archive: Archive
    inside: str
    """What of the archive it is: a folder, or an archive in it; everything when empty."""
    truth: Archive | None = None
    """A second archive with the true poses."""


def read_catalogue(path: Path = CATALOGUE) -> tuple[dict[str, Recording], dict[str, tuple[str, ...]]]:
    """Recordings and sets of them, by name."""
    record = tomllib.loads(path.read_text(encoding="utf-8"))
    found: dict[str, Recording] = {}
    for entry in record["collection"]:
        archives = entry.pop("archive")
        collection = Collection(**entry)
        for fields in archives:
            archive = _archive(fields)
            truth = _archive({"urls": [fields["truth"]]}) if "truth" in fields else None
            for name, inside in fields["sequences"].items():
                found[name] = Recording(name, collection, archive, inside, truth)
    return found, {name: tuple(names) for name, names in record.get("sets", {}).items()}


@lru_cache(maxsize=1)
def catalogue() -> tuple[dict[str, Recording], dict[str, tuple[str, ...]]]:
    """The project's own."""
    return read_catalogue()


def chosen(words: Sequence[str]) -> list[Recording]:
    """Recordings that names, patterns (``tum_fr1_*``) and sets (``readme``) stand for, each once.

    Raises:
        ConfigError: If one stands for nothing.
    """
    recordings, sets = catalogue()
    names: dict[str, None] = {}
    for word in words:
        matched = sets.get(word) or [name for name in recordings if fnmatchcase(name, word)]
        if not matched:
            close = difflib.get_close_matches(word, [*recordings, *sets], n=3, cutoff=0.4)
            hint = f"; did you mean {' or '.join(close)}?" if close else ";"
            raise ConfigError(f"no recording called {word[:80]!r}{hint} 'edgeslam data list' names them all")
        names |= dict.fromkeys(matched)
    return [recordings[name] for name in names]


def _archive(fields: dict[str, Any]) -> Archive:
    exact = int(fields.get("bytes", 0))
    return Archive(
        fields.get("file") or PurePosixPath(urlsplit(fields["urls"][0]).path).name,
        tuple(fields["urls"]),
        exact or int(fields.get("bytes_about", 0)),
        exact > 0,
        fields.get("checksum", ""),
        fields.get("checksum_by", ""),
        fields.get("doubt", ""),
        len(fields.get("sequences", ())),
    )
