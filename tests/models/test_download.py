"""Downloads: resumed, checked, and only then in place."""

import hashlib
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.download import cache_folder, download

CONTENT = bytes(range(256)) * 700


class _Handler(BaseHTTPRequestHandler):
    """Serves CONTENT with ranges; ``/short`` closes half way on the first request."""

    interrupted = False

    def do_GET(self) -> None:
        if self.path == "/missing":
            self.send_error(404)
            return
        start = int((self.headers.get("Range") or "bytes=0-").split("=")[1].split("-")[0])
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(CONTENT) - start))
        self.end_headers()
        end = len(CONTENT)
        if self.path == "/short" and not _Handler.interrupted:
            _Handler.interrupted, end = True, len(CONTENT) // 2
        self.wfile.write(CONTENT[start:end])

    def log_message(self, *_: object) -> None:
        """Quiet."""


@pytest.fixture
def server() -> Iterator[str]:
    _Handler.interrupted = False
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    thread = threading.Thread(target=httpd.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{httpd.server_port}"
    httpd.shutdown()
    httpd.server_close()


def test_second_url_is_tried_and_checksum_returned(server: str, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    digest = download(
        (f"{server}/missing", f"{server}/file"), tmp_path / "w", progress=lambda have, total: seen.append((have, total))
    )
    assert (tmp_path / "w").read_bytes() == CONTENT
    assert digest == hashlib.sha256(CONTENT).hexdigest()
    assert seen[-1] == (len(CONTENT), len(CONTENT))


def test_broken_transfer_goes_on_where_it_stopped(server: str, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="run it again"):
        download((f"{server}/short",), tmp_path / "w")
    assert not (tmp_path / "w").exists()
    assert 0 < (tmp_path / "w.part").stat().st_size < len(CONTENT)
    download((f"{server}/short",), tmp_path / "w", hashlib.sha256(CONTENT).hexdigest())
    assert (tmp_path / "w").read_bytes() == CONTENT


def test_wrong_checksum_leaves_nothing(server: str, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="checksum"):
        download((f"{server}/file",), tmp_path / "w", "0" * 64)
    assert list(tmp_path.iterdir()) == []


def test_unreachable_server_is_named(tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match="download failed: http://127.0.0.1:9/x"):
        download(("http://127.0.0.1:9/x",), tmp_path / "w")


def test_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("EDGESLAM_CACHE", str(tmp_path))
    assert cache_folder() == tmp_path
    monkeypatch.delenv("EDGESLAM_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "x"))
    assert cache_folder() == tmp_path / "x" / "edgeslam"
