"""Variants of a recording as sources: another size, calibration or order; no file is copied."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.images import frames_of
from edgeslam_torch.readers.listing import ImageEntry, Problem
from edgeslam_torch.readers.source import Recording
from edgeslam_torch.types import FloatArray, Frame, IntArray

Size = tuple[int, int]


class ChangedFrame(Frame):
    """A frame under another number, time or size; colours are still decoded on demand."""

    __slots__ = ("_frame", "_size")
    _frame: Frame
    _size: Size | None

    def __init__(self, frame: Frame, index: int, stamp_s: float, size: Size | None = None) -> None:
        """Args: ``size`` ``(width, height)`` [px]; None keeps the frame's own."""
        grey = frame.grey if frame.grey is None else _resized(frame.grey, size)
        values = {"index": index, "stamp_s": stamp_s, "path": frame.path, "grey": grey, "_frame": frame, "_size": size}
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @property
    def image(self) -> NDArray[np.uint8]:
        """``(H, W, 3)`` BGR or ``(H, W)`` grey."""
        return _resized(self._frame.image, self._size)


def _resized(image: NDArray[np.uint8], size: Size | None) -> NDArray[np.uint8]:
    return image if size is None else np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def smaller(recording: Recording, factor: int) -> Recording:
    """Images ``factor`` times smaller in width and height, and the camera with them."""
    size = (recording.camera.width // factor, recording.camera.height // factor)

    def decode(problems: list[Problem]) -> Iterator[Frame]:
        return (ChangedFrame(f, f.index, f.stamp_s, size) for f in recording.decode(problems))

    return replace(recording, decode=decode, camera=recording.camera.scaled(*size))


def with_focal_length(recording: Recording, factor: float) -> Recording:
    """The same images with a calibration whose focal lengths are wrong by ``factor``."""
    camera = recording.camera
    return replace(recording, camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy))


def perturbed(recording: Recording, draw: int, sigma_px: float) -> Recording:
    """The recording with its calibration perturbed by ``sigma_px``.

    The perturbation is far below the accuracy of keypoints, so it measures the scatter of results by chance.
    """
    camera = recording.camera
    off = np.random.default_rng(draw).normal(0.0, sigma_px, 4)
    values = (np.array([camera.fx, camera.fy, camera.cx, camera.cy]) + off).tolist()
    return replace(recording, camera=replace(camera, **dict(zip(("fx", "fy", "cx", "cy"), values, strict=True))))


def reordered(recording: Recording, images: Sequence[ImageEntry], order: IntArray, stamps_s: FloatArray) -> Recording:
    """Those of its ``images`` with the numbers ``order`` ``(N,)``, under stamps ``(N,)``, and without other sensors."""
    played = [ImageEntry(i, stamp, images[k].path) for i, (k, stamp) in enumerate(zip(order, stamps_s, strict=True))]
    size = recording.camera.width, recording.camera.height

    def decode(problems: list[Problem]) -> Iterator[Frame]:
        return frames_of(played, size, problems)

    return replace(
        recording, decode=decode, count=len(played), telemetry=[], imu=None, imu_readings=None, groundtruth=None
    )


def backwards(stamps_s: FloatArray) -> tuple[IntArray, FloatArray]:
    """Order and stamps of a recording played from its end over the same interval."""
    return np.arange(len(stamps_s))[::-1], (stamps_s[0] + stamps_s[-1] - stamps_s)[::-1]


def cut(stamps_s: FloatArray, segments: Sequence[Sequence[int]]) -> tuple[IntArray, FloatArray]:
    """Order and stamps of stretches, first frame to the one after the last, played one after the other at one pace."""
    order = np.concatenate([np.arange(first, last) for first, last in segments])
    return order, stamps_s[0] + float(np.median(np.diff(stamps_s))) * np.arange(len(order))


def followed_by(first: Recording, second: Recording, count: int, rate_hz: float) -> Recording:
    """A film with a cut: ``count`` frames of one recording, then of another with the same camera, by it alone."""

    def decode(problems: list[Problem]) -> Iterator[Frame]:
        both = chain.from_iterable(islice(one.decode(problems), count) for one in (first, second))
        return (ChangedFrame(frame, i, i / rate_hz) for i, frame in enumerate(both))

    return replace(first, decode=decode, count=2 * count, telemetry=[], imu=None, imu_readings=None, groundtruth=None)


def made_of(images: Callable[[int], NDArray[np.uint8]], count: int, camera: Camera, rate_hz: float) -> Recording:
    """A recording of ``count`` images ``(H, W, 3)`` that a function makes from their numbers."""

    def decode(_: list[Problem]) -> Iterator[Frame]:
        return (Frame(i, i / rate_hz, images(i)) for i in range(count))

    return Recording("made up", "images", "made up", camera, decode, count)
