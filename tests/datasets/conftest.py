"""A publisher on this machine, with the faults that publishers have."""

import hashlib
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest


class Publisher:
    """Serves ``files`` by path, with ranges and ETags; ``requests`` has the path and range of each request."""

    def __init__(self):
        self.files = {}
        self.requests = []
        self.breaks = {}
        """Bytes after which the next answer for a path breaks off."""
        self.redirects = {}
        self.agents = set()
        self.has_ranges = True
        publisher = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self):
                asked = self.headers.get("Range") or ""
                publisher.requests.append((self.path, asked))
                publisher.agents.add(self.headers.get("User-Agent") or "")
                if self.path in publisher.redirects:
                    self.send_response(302)
                    self.send_header("Location", publisher.redirects[self.path])
                    self.end_headers()
                    return
                content = publisher.files.get(self.path)
                if content is None:
                    self.send_error(404)
                    return
                tag = f'"{hashlib.md5(content).hexdigest()}"'
                start = int(asked.split("=")[1].split("-")[0]) if asked and publisher.has_ranges else 0
                if self.headers.get("If-Range", tag) != tag:
                    start = 0
                if start >= len(content):
                    self.send_error(416)
                    return
                self.send_response(206 if start else 200)
                if start:
                    self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
                self.send_header("ETag", tag)
                self.send_header("Content-Length", str(len(content) - start))
                self.end_headers()
                end = publisher.breaks.pop(self.path, len(content))
                self.wfile.write(content[start:end])

            def log_message(self, *_):
                """Quiet."""

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self._server.serve_forever, args=(0.01,), daemon=True).start()
        self.address = f"http://127.0.0.1:{self._server.server_port}"

    def stop(self):
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def publisher():
    started = Publisher()
    yield started
    started.stop()
