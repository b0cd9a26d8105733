"""Downloads that resume after an interruption, and checksums stored at the first download."""

import http.client
import re
import shutil
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.plain import create, extend

CHUNK = 1 << 16
TIMEOUT_S = 30.0
ANSWER_S = 90.0
"""Longest wait for an answer with its headers: a server may send one byte at a time."""
LOWEST_SPEED = 10e3
"""Bytes a second, over `WATCHED_S` each; a slower server is given up. It also ends the time that a file may take."""
WATCHED_S = 60.0
LONGEST_S = 12 * 3600.0
"""A download that takes longer is resumed by the next call."""
_ATTEMPTS = 3
"""At one address, each going on where the last one broke off."""
USER_AGENT = "edgeslam-torch"
"""Some repositories of universities refuse Python's own."""

Progress = Callable[[int, int], None]
"""Called with bytes so far and in total (0 if unknown)."""


def fetch(url: str, part: Path, max_bytes: int, progress: Progress | None = None) -> None:
    """Fetch into ``part``, going on behind what is there if the server still has the same file.

    Args:
        url: Http or https; https may not lead to anything else.
        part: Grows; its ETag is kept beside it.
        max_bytes: A server that offers or sends more is refused.
        progress: See `Progress`.

    Raises:
        OSError: If the connection cannot be made, breaks (`urllib.error.URLError` is one) or is too slow, or the disk
            is full.
        http.client.HTTPException: If the answer is no HTTP.
        ValueError: If the server sends too much, or another piece than was asked for.
    """
    have = part.stat().st_size if part.is_file() else 0
    tag = _tag_file(part)
    request = urllib.request.Request(url, headers={"User-Agent": USER_AGENT, "Accept-Encoding": "identity"})
    if have:
        request.add_header("Range", f"bytes={have}-")
        with suppress(OSError):
            request.add_header("If-Range", tag.read_text("ascii"))
    try:
        response = _answer(request)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # the partial file was complete
            return
        raise
    with response:
        have = _continued_at(response, have)
        total = have + int(response.headers.get("Content-Length") or 0)
        if total > max_bytes:
            raise ValueError(f"the server offers {total} bytes")
        if shutil.disk_usage(part.parent).free < total - have:
            raise OSError(f"the disk has no room for {total - have} bytes")
        etag = response.headers.get("ETag", "")
        if etag.startswith('"') and etag.isascii():  # weak ones do not promise the same bytes
            write_text(tag, etag)
        with extend(part) if have else create(part) as file:
            began_s = watched_s = time.monotonic()
            watched = have
            while chunk := response.read1(CHUNK):
                file.write(chunk)
                have += len(chunk)
                if have > max_bytes:
                    raise ValueError(f"the server sends more than {max_bytes} bytes")
                if progress is not None:
                    progress(have, total)
                now_s = time.monotonic()
                if now_s - began_s > LONGEST_S:
                    raise TimeoutError(f"it takes more than {LONGEST_S / 3600:.0f} hours")
                if now_s - watched_s > WATCHED_S:
                    if have - watched < LOWEST_SPEED * (now_s - watched_s):
                        raise TimeoutError(f"the server sends less than {LOWEST_SPEED / 1e3:.0f} kB/s")
                    watched_s, watched = now_s, have
        if total and have < total:
            raise OSError(f"connection lost after {have} of {total} bytes")


class DownloadError(Exception):
    """No address gave the file; the message has the reasons."""


def fetch_any(
    urls: Sequence[str], target: Path, max_bytes: int, progress: Progress | None = None, size: int = 0
) -> tuple[str, Path]:
    """Fetch from the first address that gives the file, going on after interruptions.

    Args:
        urls: Addresses, tried in order.
        target: The partial files lie beside it, one a protocol: bytes received over http stay untrusted.
        max_bytes: As for `fetch`.
        progress: As for `fetch`.
        size: Exact number of bytes; 0 if unknown.

    Returns:
        The address, and the partial file, which is whole.

    Raises:
        DownloadError: If none does; what was received is kept for the next call.
    """
    reasons = []
    for url in urls:
        part = target.with_name(f"{target.name}.{url.split(':')[0]}.part")
        for attempt in range(_ATTEMPTS):
            had = part.stat().st_size if part.is_file() else 0
            try:
                fetch(url, part, max_bytes, progress)
                if size and part.stat().st_size != size:
                    wrong = f"has {part.stat().st_size} bytes instead of {size}"
                    discard(part)
                    raise ValueError(wrong)
                return url, part
            except FAILURES as error:
                gained = part.is_file() and part.stat().st_size > had
                if attempt + 1 == _ATTEMPTS or not gained:
                    reasons.append(f"{url} ({reason_of(error)})")
                    break
    raise DownloadError("; ".join(reasons))


def _answer(request: urllib.request.Request) -> Any:
    """The server's answer, its body unread; the time-out of a socket restarts with every byte."""
    found: list[Any] = []

    def ask() -> None:
        try:
            found.append(urllib.request.build_opener(KeepEncryption).open(request, timeout=TIMEOUT_S))
        except Exception as error:
            found.append(error)

    thread = threading.Thread(target=ask, name="download", daemon=True)
    thread.start()
    thread.join(ANSWER_S)
    if not found:
        raise TimeoutError(f"no answer in {ANSWER_S:.0f} s")
    if isinstance(found[0], Exception):
        raise found[0]
    return found[0]


def discard(part: Path) -> None:
    """Remove a partial file."""
    part.unlink(missing_ok=True)
    _tag_file(part).unlink(missing_ok=True)


def reason_of(error: BaseException) -> str:
    """What went wrong with a download, in one short line."""
    reason = getattr(error, "reason", error)
    return " ".join(str(reason).split())[:120] or type(reason).__name__


FAILURES = (http.client.HTTPException, OSError, ValueError)
"""What `fetch` raises."""


class KeepEncryption(urllib.request.HTTPRedirectHandler):
    """Refuses redirects from https to other protocols."""

    def redirect_request(
        self, request: urllib.request.Request, file: IO[bytes], code: int, message: str, headers: Any, url: str
    ) -> urllib.request.Request | None:
        if request.type == "https" and not url.startswith("https:"):
            raise urllib.error.URLError(f"redirects from https to {url[:80]}")
        return super().redirect_request(request, file, code, message, headers, url)


def remembered(target: Path) -> str | None:
    """SHA-256 of a file's first download; None if there was none."""
    try:
        words = _checksum_file(target).read_text("utf-8").split()
    except (OSError, ValueError):
        return None
    return words[0].lower() if words and re.fullmatch("[0-9a-fA-F]{64}", words[0]) else None


def remember(target: Path, sha256: str) -> Path:
    """Store a checksum beside its file, in the format of ``sha256sum -c``."""
    path = _checksum_file(target)
    write_text(path, f"{sha256}  {target.name}\n")
    return path


def _continued_at(response: Any, have: int) -> int:
    """Bytes that need not be sent again; 0 when the server restarts."""
    if response.status != 206:
        return 0
    stated = re.match(r"bytes (\d+)-", response.headers.get("Content-Range") or f"bytes {have}-")
    if stated is None or int(stated[1]) != have:
        raise ValueError(f"the server does not resume at byte {have}")
    return have


def _checksum_file(target: Path) -> Path:
    return target.with_name(f"{target.name}.sha256")


def _tag_file(part: Path) -> Path:
    return part.with_name(f"{part.name}.etag")
