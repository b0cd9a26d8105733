"""Cameras that people have: RTSP, MJPEG over HTTP, GStreamer pipelines, a webcam."""

import shutil
import threading
from contextlib import closing, contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import count

import cv2
import numpy as np
import pytest
from free_ports import free_ports
from streams import coded

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.live import open_live, without_password
from edgeslam_torch.readers.source import open_source


@contextmanager
def served(pieces, multipart=True):
    """Address of a camera that sends pieces until nobody listens."""

    class Camera(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            if multipart:
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            with suppress(OSError):
                for piece in pieces:
                    self.wfile.write(piece)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Camera)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/video"
    finally:
        server.shutdown()
        server.server_close()


def part(colour, size=(64, 48)):
    """A picture of a phone's camera app."""
    data = cv2.imencode(".jpg", np.full((size[1], size[0], 3), colour, np.uint8))[1].tobytes()
    return f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n".encode() + data + b"\r\n"


def test_a_phones_mjpeg_over_http():
    with served([part((255, 0, 0)), *[part((0, 0, 255))] * 199]) as address:
        frames = list(open_source(address, max_frames=2).frames())
    assert frames and frames[0].image.shape == (48, 64, 3)
    assert np.abs(frames[-1].image[20, 20].astype(int) - (0, 0, 255)).max() < 10


@pytest.mark.parametrize("is_mjpeg", [True, False])
def test_a_stream_whose_resolution_changes_ends_with_its_reason_and_is_not_stretched(is_mjpeg):
    encode = coded("libx264", "h264")
    large, small = (part(90, size) if is_mjpeg else encode(*size, 5) for size in ((128, 96), (128, 48)))
    changed = threading.Event()
    with served((small if changed.is_set() else large for _ in count()), is_mjpeg) as address:
        frames = open_source(address).frames()
        with (
            closing(frames),
            pytest.raises(SourceError, match="128x48 now and were 128x96: the resolution"),
        ):
            for frame in frames:
                assert frame.image.shape == (96, 128, 3)
                changed.set()


def test_an_address_where_nobody_is_is_refused_without_its_password():
    (port,) = free_ports(1)
    with pytest.raises(SourceError) as caught:
        open_live(f"rtsp://user:secret@127.0.0.1:{port}/x")
    assert "cannot be opened" in str(caught.value) and "secret" not in str(caught.value)


def test_passwords_are_taken_out_of_addresses():
    assert without_password("rtsp://me:p%40ss@cam.local:554/1?a=b@c") == "rtsp://cam.local:554/1?a=b@c"
    assert without_password("http://cam/a@b") == "http://cam/a@b"
    assert without_password("webcam:0") == "webcam:0"


@pytest.mark.skipif(shutil.which("gst-launch-1.0") is None, reason="gst-launch-1.0 is not installed")
def test_gstreamer_pipeline():
    size = "video/x-raw,width=160,height=120,framerate=30/1"
    bars = f"gst:videotestsrc num-buffers=30 is-live=true ! {size} ! appsink drop=1"
    source = open_source(bars, max_frames=2)
    frames = list(source.frames())
    assert len(frames) == 2 and frames[0].image.shape == (120, 160, 3)
    # 75 % bars: white, yellow, cyan, green, magenta, red, blue
    yellow, blue = (frames[1].image[40, x].astype(int) for x in (33, 150))
    assert yellow[0] < 40 and min(yellow[1:]) > 150
    assert blue[0] > 150 and max(blue[1:]) < 40
    with pytest.raises(SourceError, match="no element"):
        open_live("gst:nosuchsource")
    with pytest.raises(SourceError, match="even"):
        open_live("gst:videotestsrc ! video/x-raw,width=161,height=120")


def test_gstreamer_that_is_not_installed_is_named(monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    with pytest.raises(SourceError, match="gstreamer1.0-tools"):
        open_live("gst:videotestsrc")
    with pytest.raises(SourceError, match="give a pipeline"):
        open_live("gst:")
