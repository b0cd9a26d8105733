"""Downloadable weights: sources, resumable download, verification; nothing is executed.

Their publisher states no checksums and serves plain http. So https is tried first, and the checksum of the first
download is stored beside the file and required of later ones (trust on first use).
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.files.download import DownloadError, Progress, discard, fetch_any, remembered
from edgeslam_torch.models.weights_file import MAX_FILE_BYTES


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
    urls: tuple[str, ...], target: Path, sha256: str | None = None, progress: Progress | None = None
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
    try:
        url, part = fetch_any(urls, target, MAX_FILE_BYTES, progress)
    except DownloadError as error:
        raise WeightsError(f"download failed: {error}; the part received is kept; run it again to resume") from error
    with part.open("rb") as file:
        found, before = hashlib.file_digest(file, "sha256").hexdigest(), remembered(target)
    expected = (sha256 or before or found).lower()
    if found != expected:
        discard(part)
        if sha256 is None:
            raise WeightsError(
                f"{target.name}: the file at {url} has changed since it was first downloaded: its checksum is {found}, "
                f"it was {expected}; it was not taken. If you know why, give --sha256 {found}"
            )
        raise WeightsError(f"{target.name}: checksum is {found}, expected {expected}; the file was deleted")
    part.replace(target)
    discard(part)
    return Fetched(found, url)
