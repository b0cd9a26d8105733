"""Pictures of ``Image`` and ``CompressedImage`` messages."""

import re
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.images import check_size, decode
from edgeslam_torch.readers.levels import Levels, levels_of

_CHANNELS = {"mono8": 1, "8UC1": 1, "8UC3": 3, "8UC4": 4, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
_CHANNELS |= {"yuv422": 2, "yuv422_yuy2": 2, "uyvy": 2, "yuyv": 2, "mono16": 1, "16UC1": 1}
_TO_BGR = {
    "rgb8": cv2.COLOR_RGB2BGR,
    "rgba8": cv2.COLOR_RGBA2BGR,
    "bgra8": cv2.COLOR_BGRA2BGR,
    "8UC4": cv2.COLOR_BGRA2BGR,
    "yuv422": cv2.COLOR_YUV2BGR_UYVY,  # ROS: U Y V Y
    "uyvy": cv2.COLOR_YUV2BGR_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2BGR_YUY2,
    "yuyv": cv2.COLOR_YUV2BGR_YUY2,
    # OpenCV names a pattern by its second row, ROS by its first.
    "bayer_rggb": cv2.COLOR_BayerBG2BGR,
    "bayer_bggr": cv2.COLOR_BayerRG2BGR,
    "bayer_gbrg": cv2.COLOR_BayerGR2BGR,
    "bayer_grbg": cv2.COLOR_BayerGB2BGR,
}
_DEPTH = ("16UC1", "32FC1", "64FC1", "compressedDepth")
THERMAL = "16UC1"
"""Depth maps have this encoding, and so have the pictures of thermal cameras: who names the topic means pictures."""
SUPPORTED = "mono8, mono16, rgb8, bgr8, rgba8, bgra8, bayer_*, yuv422, jpeg and png"


def depth_format(message: Any) -> str | None:
    """The format by which a picture is a depth map, which SLAM cannot use as an image; None for ordinary pictures."""
    name = _format(message)
    return next((form for form in _DEPTH if form.lower() in name.lower()), None)


def _format(message: Any) -> str:
    return str(message.encoding if hasattr(message, "encoding") else message.format)


class PictureDecoder:
    """Reads the pictures of one topic."""

    def __init__(self, name: str, levels: Levels | None = None) -> None:
        """Choose the levels of pictures of more than eight bits.

        Args:
            name: File and topic, for messages.
            levels: Default: by the first such picture.
        """
        self.name = name
        self._levels = levels

    def decode(self, message: Any) -> NDArray[np.uint8]:
        """``(H, W, 3)`` BGR or ``(H, W)`` grey, of eight bits.

        Raises:
            SourceError: As `pixels`.
        """
        picture, code = self.pixels(message)
        if picture.dtype != np.uint8:
            self._levels = self._levels or levels_of([picture])
            picture = self._levels.eight_bits(picture)
        try:
            return np.asarray(picture if code is None else cv2.cvtColor(picture, code), np.uint8)
        except cv2.error as error:
            height, width = picture.shape[:2]
            raise SourceError(f"{self.name}: {_format(message)[:40]} cannot have {width}x{height} pixels") from error

    def pixels(self, message: Any) -> tuple[NDArray[Any], int | None]:
        """The picture with all its bits, and OpenCV's code that makes it BGR; None for grey and BGR.

        Raises:
            SourceError: If the encoding is a depth map's or not known, or the picture is damaged.
        """
        form = depth_format(message)
        if form not in (None, THERMAL):
            raise SourceError(f"{self.name}: depth maps ({form}), not pictures; give the camera's --topic")
        if hasattr(message, "encoding"):
            return self._plain(message)
        data = np.asarray(message.data, dtype=np.uint8).tobytes()
        picture = decode(data, f"{self.name}: compressed as {_format(message)[:40]!r}", cv2.IMREAD_UNCHANGED)
        return picture, cv2.COLOR_BGRA2BGR if picture.shape[2:] == (4,) else None

    def _plain(self, message: Any) -> tuple[NDArray[Any], int | None]:
        encoding, (width, height) = str(message.encoding), (int(message.width), int(message.height))
        bayer = re.fullmatch(r"(bayer_(?:rggb|bggr|gbrg|grbg))(8|16)", encoding)
        channels = 1 if bayer else _CHANNELS.get(encoding)
        if channels is None:
            raise SourceError(f"{self.name}: encoding {encoding[:40]!r} is not supported; {SUPPORTED} are")
        check_size(width, height, self.name)
        deep = encoding in ("mono16", THERMAL) or bool(bayer and bayer[2] == "16")
        row = width * channels * (2 if deep else 1)
        step, data = int(message.step) or row, np.asarray(message.data, dtype=np.uint8)
        if height == 1:
            step = row
        if width < 1 or height < 1 or step < row or data.size < step * (height - 1) + row:
            raise SourceError(
                f"{self.name}: {data.size} bytes are too few for a {width}x{height} picture in {encoding}"
            )
        padded = np.zeros(step * height, np.uint8)
        padded[: min(data.size, padded.size)] = data[: padded.size]
        pixels = padded.reshape(height, step)[:, :row]
        if deep:
            order = ">u2" if message.is_bigendian else "<u2"
            image: NDArray[Any] = np.ascontiguousarray(pixels).view(order).reshape(height, width).astype(np.uint16)
        else:
            image = np.ascontiguousarray(pixels).reshape((height, width, channels) if channels > 1 else (height, width))
        return image, _TO_BGR.get(bayer[1] if bayer else encoding)
