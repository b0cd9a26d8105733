"""Weights that can be downloaded: where they are, fetched with resume, checked, never executed."""

import hashlib
import os
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.record import DEFAULT_WEIGHTS

CHUNK = 1 << 16
TIMEOUT_S = 30.0
MAX_BYTES = 1 << 30


@dataclass(frozen=True, slots=True)
class Remote:
    """A file somebody else publishes."""

    name: str
    urls: tuple[str, ...]
    """Tried in order."""
    licence: str
    about: str
    sha256: str | None = None
    """None where the publisher gives none; the user can pin one."""


_MIT = ("http://datasets.lids.mit.edu/fastdepth/results", "http://datasets.lids.mit.edu/fast-depth/results")
REMOTES = {
    name: Remote(
        name,
        tuple(f"{base}/{name}.pth.tar" for base in _MIT),
        "MIT (dwofk/fast-depth); trained on NYU Depth v2",
        about,
    )
    for name, about in {
        "mobilenet-nnconv5": "dense 5x5 decoder, 20.7 M parameters",
        "mobilenet-nnconv5dw": "depthwise decoder, 3.96 M parameters",
        "mobilenet-nnconv5dw-skipadd": "with skip connections, 3.96 M parameters",
        "mobilenet-nnconv5dw-skipadd-pruned": "pruned, 1.35 M parameters, the paper's final network",
    }.items()
}


def cache_folder() -> Path:
    """``EDGESLAM_CACHE``, else ``$XDG_CACHE_HOME/edgeslam``, else ``~/.cache/edgeslam``."""
    given = os.environ.get("EDGESLAM_CACHE")
    if given:
        return Path(given).expanduser()
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "edgeslam"


def shipped() -> Path:
    """The weights inside the package."""
    return DEFAULT_WEIGHTS


def download(
    urls: tuple[str, ...], target: Path, sha256: str | None = None, progress: Callable[[int, int], None] | None = None
) -> str:
    """Fetch the first URL that answers; a part left by an earlier try is continued.

    Args:
        urls: Where it may be.
        target: File to write; appears only when complete and right.
        sha256: What it must hash to.
        progress: Called with bytes so far and in all (0 when the server does not say).

    Returns:
        SHA-256 of the file.

    Raises:
        WeightsError: If no URL answers, the transfer breaks off, or the checksum differs.
    """
    part = target.with_name(target.name + ".part")
    target.parent.mkdir(parents=True, exist_ok=True)
    reasons = []
    for url in urls:
        try:
            _fetch(url, part, progress)
            break
        except (urllib.error.URLError, OSError, ValueError) as error:
            reasons.append(f"{url} ({getattr(error, 'reason', error)})")
    else:
        raise WeightsError(f"download failed: {'; '.join(reasons)}; what has come is kept, run it again to go on")
    found = _hash(part)
    if sha256 is not None and found != sha256.lower():
        part.unlink()
        raise WeightsError(f"{target.name}: checksum is {found}, expected {sha256.lower()}; the file was deleted")
    part.replace(target)
    return found


def _fetch(url: str, part: Path, progress: Callable[[int, int], None] | None) -> None:
    have = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        response = urllib.request.urlopen(request, timeout=TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # nothing beyond what we have: it was complete
            return
        raise
    with response:
        continued = response.status == 206
        have = have if continued else 0
        total = have + int(response.headers.get("Content-Length") or 0)
        if total > MAX_BYTES:
            raise ValueError(f"the server offers {total} bytes")
        with part.open("ab" if continued else "wb") as file:
            while chunk := response.read(CHUNK):
                file.write(chunk)
                have += len(chunk)
                if have > MAX_BYTES:
                    raise ValueError("the server sends without end")
                if progress is not None:
                    progress(have, total)
        if total and have < total:
            raise OSError(f"connection lost after {have} of {total} bytes")


def _hash(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()
