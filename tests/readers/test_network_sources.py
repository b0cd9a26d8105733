"""Cameras that people have: RTSP, MJPEG over HTTP, GStreamer pipelines, a webcam."""

import shutil
import subprocess
import sys
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest
from free_ports import free_ports

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.live import open_live, without_password
from edgeslam_torch.readers.source import open_source

SERVER = """
import sys, gi
gi.require_version("Gst", "1.0"); gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer
Gst.init(None)
if Gst.ElementFactory.find("x264enc") is None or Gst.ElementFactory.find("rtph264pay") is None:
    sys.exit("no x264enc or rtph264pay")
server = GstRtspServer.RTSPServer()
server.set_service(sys.argv[1])
factory = GstRtspServer.RTSPMediaFactory()
factory.set_launch(
    "( videotestsrc is-live=true ! video/x-raw,format=I420,width=160,height=120,framerate=15/1 "
    "! x264enc tune=zerolatency key-int-max=15 ! rtph264pay name=pay0 config-interval=1 )"
)
server.get_mount_points().add_factory("/test", factory)
server.attach(None)
print("ready", flush=True)
GLib.MainLoop().run()
"""
"""RTSP server of Debian's gir1.2-gst-rtsp-server-1.0, for Debian's own Python."""


@contextmanager
def rtsp_server():
    python = next((p for p in ("/usr/bin/python3", sys.executable) if Path(p).exists()), sys.executable)
    (port,) = free_ports(1)
    process = subprocess.Popen(
        [python, "-c", SERVER, str(port)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        if process.stdout.readline().strip() != "ready":
            pytest.skip(f"no GStreamer RTSP server here: {process.stderr.read().strip().splitlines()[-1][:120]}")
        yield f"rtsp://user:secret@127.0.0.1:{port}/test"
    finally:
        process.kill()
        process.communicate()


@pytest.mark.slow
def test_rtsp_camera_of_a_real_server():
    with rtsp_server() as address:
        source = open_source(address, max_frames=5)
        frames = list(source.frames())
    assert [frame.image.shape for frame in frames] == [(120, 160, 3)] * 5
    stamps = [frame.stamp_s for frame in frames]
    assert all(later > earlier for earlier, later in zip(stamps, stamps[1:], strict=False))
    bars = frames[-1].image[20, 5].astype(int)  # videotestsrc begins with a white bar
    assert bars.min() > 150
    assert "secret" not in source.location + source.name


class _Mjpeg(BaseHTTPRequestHandler):
    """A phone's camera app: pictures one after the other, the first blue, then red."""

    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        for i in range(200):
            colour = (255, 0, 0) if i == 0 else (0, 0, 255)
            data = cv2.imencode(".jpg", np.full((48, 64, 3), colour, np.uint8))[1].tobytes()
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            try:
                self.wfile.write(head.encode() + data + b"\r\n")
            except OSError:
                return

    def log_message(self, *_):
        pass


def test_a_phones_mjpeg_over_http():
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Mjpeg)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        source = open_source(f"http://127.0.0.1:{server.server_port}/video", max_frames=2)
        frames = list(source.frames())
    finally:
        server.shutdown()
        server.server_close()
    assert frames and frames[0].image.shape == (48, 64, 3)
    assert np.abs(frames[-1].image[20, 20].astype(int) - (0, 0, 255)).max() < 10


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


@pytest.mark.skipif(not Path("/dev/video0").exists(), reason="no camera at /dev/video0")
def test_webcam():
    source = open_source("webcam:0", max_frames=2)
    assert len(list(source.frames())) == 2
