"""Downloads: resumed, checked, and only then in place."""

import hashlib
import io
import socket
import threading
import urllib.error
import urllib.request
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.files import download as fetching
from edgeslam_torch.files.download import KeepEncryption, remember, remembered
from edgeslam_torch.models.download import download

CONTENT = bytes(range(256)) * 700


class _Handler(BaseHTTPRequestHandler):
    """Serves ``content`` with ranges; ``/short`` closes half way on the first request, ``/garbage`` speaks no HTTP."""

    interrupted = False
    content = CONTENT

    def do_GET(self):
        if self.path == "/missing":
            self.send_error(404)
            return
        if self.path == "/garbage":
            self.wfile.write(b"\x00\x01 hello\r\n\r\n")
            return
        content = _Handler.content
        start = int((self.headers.get("Range") or "bytes=0-").split("=")[1].split("-")[0])
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(content) - start))
        self.end_headers()
        end = len(content)
        if self.path == "/short" and not _Handler.interrupted:
            _Handler.interrupted, end = True, len(content) // 2
        self.wfile.write(content[start:end])

    def log_message(self, *_):
        """Quiet."""


@pytest.fixture
def server():
    _Handler.interrupted, _Handler.content = False, CONTENT
    httpd = ThreadingHTTPServer(("127.0.0.1", 0), _Handler)
    thread = threading.Thread(target=httpd.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{httpd.server_port}"
    httpd.shutdown()
    httpd.server_close()


def test_broken_transfer_goes_on_where_it_stopped(server, tmp_path):
    download((f"{server}/short",), tmp_path / "w", hashlib.sha256(CONTENT).hexdigest())
    assert _Handler.interrupted and (tmp_path / "w").read_bytes() == CONTENT


def test_wrong_checksum_leaves_nothing(server, tmp_path):
    with pytest.raises(WeightsError, match="checksum"):
        download((f"{server}/file",), tmp_path / "w", "0" * 64)
    assert list(tmp_path.iterdir()) == []


# -- trust on first use --------------------------------------------------------------------------------------------


def test_a_file_that_changed_since_the_first_download_is_not_taken(server, tmp_path):
    first = download((f"{server}/file",), tmp_path / "w")
    remember(tmp_path / "w", first.sha256)
    assert download((f"{server}/file",), tmp_path / "w").sha256 == first.sha256
    _Handler.content = CONTENT[:-1] + b"!"
    changed = hashlib.sha256(_Handler.content).hexdigest()
    with pytest.raises(WeightsError, match=f"has changed since .*{changed}.*{first.sha256}.*--sha256 {changed}"):
        download((f"{server}/file",), tmp_path / "w")
    assert (tmp_path / "w").read_bytes() == CONTENT
    assert sorted(p.name for p in tmp_path.iterdir()) == ["w", "w.sha256"]
    assert download((f"{server}/file",), tmp_path / "w", changed).sha256 == changed


@pytest.mark.parametrize("content", [b"", b"nonsense", b"12 w", b"\xff\xfe", b"g" * 64])
def test_a_kept_checksum_that_is_none_counts_as_none(tmp_path, content):
    (tmp_path / "w.sha256").write_bytes(content)
    assert remembered(tmp_path / "w") is None


def test_https_is_not_left_by_a_redirect():
    handler, body = KeepEncryption(), io.BytesIO()
    for start, end, allowed in (
        ("https://a/x", "https://b/x", True),
        ("https://a/x", "http://a/x", False),
        ("https://a/x", "ftp://a/x", False),
        ("http://a/x", "https://a/x", True),
        ("http://a/x", "http://b/x", True),
    ):
        request = urllib.request.Request(start)
        if allowed:
            assert handler.redirect_request(request, body, 302, "", {}, end) is not None
        else:
            with pytest.raises(urllib.error.URLError, match="redirects from https"):
                handler.redirect_request(request, body, 302, "", {}, end)


@pytest.mark.parametrize("limits", [{"WATCHED_S": -1.0, "LOWEST_SPEED": 1e15}, {"LONGEST_S": -1.0}])
def test_a_server_that_drips_or_never_ends_is_given_up(server, tmp_path, monkeypatch, limits):
    for name, value in limits.items():
        monkeypatch.setattr(fetching, name, value)
    with pytest.raises(TimeoutError):
        fetching.fetch(f"{server}/good", tmp_path / "part", 1 << 30)


def test_a_server_that_accepts_and_says_nothing_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setattr(fetching, "ANSWER_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/x"
        with pytest.raises(TimeoutError, match="no answer"):
            fetching.fetch(url, tmp_path / "part", 1 << 30)


def test_second_url_is_tried_and_checksum_returned(server, tmp_path):
    seen = []
    fetched = download(
        (f"{server}/missing", f"{server}/file"), tmp_path / "w", progress=lambda have, total: seen.append((have, total))
    )
    assert (tmp_path / "w").read_bytes() == CONTENT
    assert fetched.sha256 == hashlib.sha256(CONTENT).hexdigest()
    assert seen[-1] == (len(CONTENT), len(CONTENT))


def test_kept_checksum_is_what_sha256sum_reads(tmp_path):
    digest = hashlib.sha256(CONTENT).hexdigest()
    assert remembered(tmp_path / "w") is None
    remember(tmp_path / "w", digest)
    assert (tmp_path / "w.sha256").read_text() == f"{digest}  w\n"
    assert remembered(tmp_path / "w") == digest


def test_a_server_without_http_is_one_line(server, tmp_path):
    with pytest.raises(WeightsError, match="download failed") as caught:
        download((f"{server}/garbage",), tmp_path / "w")
    assert "\n" not in str(caught.value)
