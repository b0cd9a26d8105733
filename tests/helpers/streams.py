"""Videos of a few moving pictures, as cameras and encoders write them."""

import io

import cv2
import numpy as np
import pytest


def mjpeg(width, height, count):
    """JPEGs one after the other."""
    picture = np.full((height, width, 3), 90, np.uint8)
    return cv2.imencode(".jpg", picture)[1].tobytes() * count


def coded(codec, form):
    """Function that gives a stream of a codec in a container: ``stream(width, height, count)``."""

    def stream(width, height, count):
        av = pytest.importorskip("av")
        clip = io.BytesIO()
        with av.open(clip, "w", format=form) as container:
            stream = container.add_stream(codec, rate=25, width=width, height=height, pix_fmt="yuv420p")
            texture = cv2.resize(np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8), (width, height))
            moving = (av.VideoFrame.from_ndarray(np.roll(texture, i, 1), format="bgr24") for i in range(count))
            for packet in [*(p for picture in moving for p in stream.encode(picture)), *stream.encode(None)]:
                container.mux(packet)
        return clip.getvalue()

    return stream
