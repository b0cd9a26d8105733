"""Packets of a video: OpenCV's decoder stretches all pictures to the first one's size, and does not say so."""

import re
import tempfile
from collections.abc import Callable
from importlib.util import find_spec

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.drone.video_stream import import_av
from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.image_size import image_size
from edgeslam_torch.readers.images import decode

_CODECS = {b"MJPG": "mjpeg", b"jpeg": "mjpeg", b"mjpg": "mjpeg"} | dict.fromkeys((b"\x1b\0\0\0", b"\7\0\0\0"), "h264")
_CODECS |= dict.fromkeys((b"h264", b"H264", b"avc1"), "h264")
_CODECS |= dict.fromkeys((b"hevc", b"hev1", b"hvc1", b"$\0\0\0"), "hevc")
"""A stream's four letters, or the number of its kind in MPEG-TS and FLV."""
_JPEG = b"\xff\xd8"
_PARAMETERS = re.compile(rb"\0\0\x01(?:[\x07\x27\x47\x67]|\x42\x01).*?(?=\0\0[\0\x01]|$)", re.DOTALL)
"""An H.264 or HEVC stream's sequence parameters, size included, before the pictures that have them."""
_MAX_PARAMETERS = 64
"""Different ones that are looked at; a joined video has as many as parts."""


def codec_of(capture: cv2.VideoCapture) -> str | None:
    """FFmpeg's name of the coding: ``mjpeg``, ``h264`` or ``hevc``; None for all others."""
    return _CODECS.get((int(capture.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF).to_bytes(4, "little"))


def decoded_here(capture: cv2.VideoCapture) -> "Packets | None":
    """An open stream whose pictures keep their sizes; None for other codings, and without PyAV all but MJPEG."""
    codec = codec_of(capture)
    return None if codec is None or (codec != "mjpeg" and find_spec("av") is None) else Packets(capture, codec)


class Packets:
    """A stream that is received by OpenCV and decoded here; reads as `cv2.VideoCapture` does.

    A packet that completes no picture gives None.
    """

    def __init__(self, capture: cv2.VideoCapture, codec: str) -> None:
        capture.set(cv2.CAP_PROP_FORMAT, -1)
        self._capture = capture
        self._decode = _decode_jpeg if codec == "mjpeg" else _decoder(codec, capture)
        self.release = capture.release

    def read(self) -> tuple[bool, NDArray[np.uint8] | None]:
        """Whether the stream goes on, and the newest picture ``(H, W, 3)`` BGR, if one is whole."""
        ok, packet = self._capture.read()
        return (True, self._decode(packet.tobytes())) if ok else (False, None)


def _decode_jpeg(packet: bytes) -> NDArray[np.uint8] | None:
    try:
        return np.asarray(decode(packet, "picture", cv2.IMREAD_COLOR), np.uint8)
    except SourceError:
        return None


def _decoder(codec: str, capture: cv2.VideoCapture) -> Callable[[bytes], NDArray[np.uint8] | None]:
    av = import_av()
    context = av.CodecContext.create(codec, "r")
    context.thread_count = 1  # frame threads would delay pictures
    _, parameters = capture.retrieve(flag=int(capture.get(cv2.CAP_PROP_CODEC_EXTRADATA_INDEX)))
    if parameters is not None and not any(parameters.ravel()[:2]):  # else they are MP4's and repeated in the packets
        context.extradata = parameters.tobytes()

    def newest(packet: bytes) -> NDArray[np.uint8] | None:
        try:
            frames = [frame for frame in context.decode(av.Packet(packet)) if not frame.is_corrupt]
            return np.asarray(frames[-1].to_ndarray(format="bgr24")) if frames else None
        except (av.error.FFmpegError, ValueError):
            return None

    return newest


def change_of_size(packets: cv2.VideoCapture, size: tuple[int, int]) -> tuple[int, tuple[int, int] | None, int]:
    """Index and size of the first picture of another size, and how many pictures there are from it on; without one, the
    number of all pictures, None, 0; with other codings than those of `codec_of`, 0, None, 0.

    Args:
        packets: A video, which is read to its end and released.
        size: ``(width, height)`` of the pictures before.
    """
    codec = codec_of(packets)
    packets.set(cv2.CAP_PROP_FORMAT, -1)
    index, known = 0, set[bytes]()
    try:
        while codec is not None and (packet := packets.read())[0]:
            data = packet[1].tobytes()
            found = _PARAMETERS.search(data[:4096])
            now: tuple[int, int] | None = size
            if data.startswith(_JPEG):
                now = image_size(data)
            elif found is not None and found[0] not in known and len(known) < _MAX_PARAMETERS:
                known.add(found[0])
                now = _size_of(data, f".{codec}")
            elif not known:  # what comes before the first parameters cannot be decoded
                continue
            if now not in (None, size):
                return index, now, 1 + sum(1 for _ in iter(packets.grab, False))
            index += 1
    finally:
        packets.release()
    return index, None, 0


def _size_of(packet: bytes, suffix: str) -> tuple[int, int] | None:
    """Size of the picture that begins a stream; None if there is none."""
    with tempfile.NamedTemporaryFile(suffix=suffix) as file:
        file.write(packet)
        file.flush()
        capture = cv2.VideoCapture(file.name, cv2.CAP_FFMPEG)
        ok, image = capture.read()
        capture.release()
    return (image.shape[1], image.shape[0]) if ok else None
