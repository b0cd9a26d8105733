"""Downloadable weights: sources, resumable download, verification; nothing is executed.

Their publisher states no checksums and serves plain http. So https is tried first, and the checksum of the first
download is stored beside the file and required of later ones (trust on first use).
"""

import hashlib
import http.client
import os
import re
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.models.record import DEFAULT_WEIGHTS
from edgeslam_torch.models.weights_file import MAX_FILE_BYTES

CHUNK = 1 << 16
TIMEOUT_S = 30.0


@dataclass(frozen=True, slots=True)
class Remote:
    """A file published by others."""

    name: str
    urls: tuple[str, ...]
    """Tried in order."""
    licence: str
    about: str


_MIT = tuple(
    f"{scheme}://datasets.lids.mit.edu/{folder}/results"
    for scheme in ("https", "http")
    for folder in ("fastdepth", "fast-depth")
)
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


@dataclass(frozen=True, slots=True)
class Fetched:
    """Result of a download."""

    sha256: str
    url: str
    """Address that it came from."""

    @property
    def encrypted(self) -> bool:
        """Whether the transfer was encrypted."""
        return self.url.startswith("https:")


def download(
    urls: tuple[str, ...], target: Path, sha256: str | None = None, progress: Callable[[int, int], None] | None = None
) -> Fetched:
    """Fetch from the first URL that answers, resuming a partial download.

    Args:
        urls: Addresses, tried in order.
        target: File to write; appears only when complete and verified.
        sha256: Expected checksum; None for the one that `remember` stored.
        progress: Called with bytes so far and in total (0 if unknown).

    Raises:
        WeightsError: If no URL answers, the transfer breaks off, or the checksum differs.
        OSError: If the file cannot be written.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    reasons = []
    for url in urls:
        # One partial file per protocol: bytes received over http stay untrusted.
        part = target.with_name(f"{target.name}.{url.split(':')[0]}.part")
        try:
            _fetch(url, part, progress)
            break
        except (http.client.HTTPException, OSError, ValueError) as error:
            reasons.append(f"{url} ({_one_line(getattr(error, 'reason', error))})")
    else:
        raise WeightsError(f"download failed: {'; '.join(reasons)}; what has come is kept, run it again to go on")
    found, before = _hash(part), remembered(target)
    expected = (sha256 or before or found).lower()
    if found != expected:
        part.unlink()
        if sha256 is None:
            raise WeightsError(
                f"{target.name}: the file at {url} has changed since it was first downloaded: its checksum is {found}, "
                f"it was {expected}; it was not taken. If you know why, give --sha256 {found}"
            )
        raise WeightsError(f"{target.name}: checksum is {found}, expected {expected}; the file was deleted")
    part.replace(target)
    return Fetched(found, url)


def remembered(target: Path) -> str | None:
    """Checksum of a file's first download; None if there was none."""
    try:
        words = _checksum_file(target).read_text("utf-8").split()
    except (OSError, ValueError):
        return None
    return words[0].lower() if words and re.fullmatch("[0-9a-fA-F]{64}", words[0]) else None


def remember(target: Path, sha256: str) -> Path:
    """Store a checksum beside its file, in the format of ``sha256sum -c``.

    Raises:
        OSError: If the file cannot be written.
    """
    path = _checksum_file(target)
    write_text(path, f"{sha256}  {target.name}\n")
    return path


def _checksum_file(target: Path) -> Path:
    return target.with_name(f"{target.name}.sha256")


def _one_line(reason: object) -> str:
    return " ".join(str(reason).split())[:120] or type(reason).__name__


class _KeepEncryption(urllib.request.HTTPRedirectHandler):
    """Refuses redirects from https to other protocols."""

    def redirect_request(
        self, request: urllib.request.Request, file: IO[bytes], code: int, message: str, headers: Any, url: str
    ) -> urllib.request.Request | None:
        if request.type == "https" and not url.startswith("https:"):
            raise urllib.error.URLError(f"leads from https to {url[:80]}")
        return super().redirect_request(request, file, code, message, headers, url)


def _fetch(url: str, part: Path, progress: Callable[[int, int], None] | None) -> None:
    have = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        response = urllib.request.build_opener(_KeepEncryption).open(request, timeout=TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # the partial file was complete
            return
        raise
    with response:
        continued = response.status == 206
        have = have if continued else 0
        total = have + int(response.headers.get("Content-Length") or 0)
        if total > MAX_FILE_BYTES:
            raise ValueError(f"the server offers {total} bytes")
        with part.open("ab" if continued else "wb") as file:
            while chunk := response.read(CHUNK):
                file.write(chunk)
                have += len(chunk)
                if have > MAX_FILE_BYTES:
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
