"""H.264 as a Tello sends it: Annex B, a keyframe every second, in datagrams of at most 1460 bytes."""

from fractions import Fraction

import numpy as np

from edgeslam_torch.drone.video_stream import CHUNK, import_av


class Encoder:
    """One picture in, datagrams out."""

    def __init__(self, width: int, height: int, rate_hz: int, bit_rate: int = 4_000_000) -> None:
        av = import_av()
        self._av = av
        self._context = av.CodecContext.create("libx264", "w")
        self._context.width, self._context.height = width, height
        self._context.pix_fmt = "yuv420p"
        self._context.framerate = rate_hz
        self._context.time_base = Fraction(1, rate_hz)
        self._context.bit_rate = bit_rate
        self._context.gop_size = rate_hz
        self._context.max_b_frames = 0
        self._context.thread_count = 1
        self._context.options = {
            "preset": "ultrafast",
            "tune": "zerolatency",
            "profile": "baseline",
            "x264-params": "repeat-headers=1:annexb=1:scenecut=0",
        }
        self._index = 0

    def encode(self, image: np.ndarray) -> list[bytes]:
        """Datagrams of one BGR picture ``(H, W, 3)``."""
        frame = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="bgr24").reformat(format="yuv420p")
        frame.pts = self._index
        self._index += 1
        data = b"".join(bytes(packet) for packet in self._context.encode(frame))
        return [data[i : i + CHUNK] for i in range(0, len(data), CHUNK)]
