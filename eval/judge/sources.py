"""Variants of a recording as sources: another rate, size, start, focal length or order; no file is copied."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.images import frames_of
from edgeslam_torch.readers.listing import ImageEntry, Problem
from edgeslam_torch.readers.source import Recording
from edgeslam_torch.types import FloatArray, Frame

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


def every(recording: Recording, step: int) -> Recording:
    """Every ``step``-th frame, numbered anew, with its own stamp."""
    return _picked(recording, lambda frames: islice(frames, 0, None, step), _divided_up(recording.length, step))


def start_at(recording: Recording, first: int) -> Recording:
    """Without the first frames; telemetry starts one second before the first remaining frame."""
    length = None if recording.length is None else max(0, recording.length - first)
    later = _picked(recording, lambda frames: islice(frames, first, None), length)
    start = next(later.decode([]), None) if recording.telemetry else None
    if start is None:
        return later
    return replace(later, telemetry=[s for s in recording.telemetry if s.stamp_s >= start.stamp_s - 1.0])


def first_frames(recording: Recording, count: int) -> Recording:
    """No more than ``count`` frames."""
    length = count if recording.length is None else min(count, recording.length)
    return _picked(recording, lambda frames: islice(frames, count), length)


def smaller(recording: Recording, factor: int) -> Recording:
    """Images ``factor`` times smaller in width and height, and the camera with them."""
    camera = recording.camera
    size = (camera.width // factor, camera.height // factor)

    def decode(problems: list[Problem]) -> Iterator[Frame]:
        return (ChangedFrame(f, f.index, f.stamp_s, size) for f in recording.decode(problems))

    return replace(recording, decode=decode, camera=camera.scaled(*size))


def with_focal_length(recording: Recording, factor: float) -> Recording:
    """The same images with a calibration whose focal lengths are wrong by ``factor``."""
    camera = recording.camera
    return replace(recording, camera=replace(camera, fx=factor * camera.fx, fy=factor * camera.fy))


def perturbed(recording: Recording, draw: int, sigma_px: float) -> Recording:
    """The recording from its ``draw``-th frame on, with its calibration perturbed by ``sigma_px``.

    The perturbation is far below the accuracy of keypoints, so it measures the scatter of results by chance.
    """
    camera = recording.camera
    off = np.random.default_rng(draw).normal(0.0, sigma_px, 4)
    values = (np.array([camera.fx, camera.fy, camera.cx, camera.cy]) + off).tolist()
    other = replace(camera, **dict(zip(("fx", "fy", "cx", "cy"), values, strict=True)))
    return replace(start_at(recording, draw), camera=other)


@dataclass(frozen=True, slots=True)
class Cut:
    """Stretches of a recording played one after the other, at one frame a period."""

    segments: tuple[tuple[int, int], ...]
    """First frame and the one after the last, by number in the recording."""
    stamps_s: FloatArray
    """``(F,)`` stamps of the whole recording [s]."""

    @property
    def originals(self) -> NDArray[np.int64]:
        """Number in the recording of every frame played, ``(N,)``."""
        return np.concatenate([np.arange(first, last) for first, last in self.segments])

    @property
    def new_stamps_s(self) -> FloatArray:
        """Stamps under which they are played, ``(N,)``."""
        period_s = float(np.median(np.diff(self.stamps_s)))
        return self.stamps_s[0] + period_s * np.arange(len(self.originals))


def cut(recording: Recording, plan: Cut) -> Recording:
    """The stretches of ``plan`` as one recording, without telemetry; its ground truth must be cut the same way."""
    stamps = plan.new_stamps_s

    def decode(problems: list[Problem]) -> Iterator[Frame]:
        begin = 0
        for first, last in plan.segments:
            for frame in recording.decode(problems):
                if frame.index >= last:
                    break
                if frame.index >= first:
                    index = begin + frame.index - first
                    yield ChangedFrame(frame, index, float(stamps[index]))
            begin += last - first

    return replace(recording, decode=decode, length=len(stamps), telemetry=[], groundtruth=None)


def followed_by(first: Recording, second: Recording, count: int, rate_hz: float) -> Recording:
    """A film with a cut: ``count`` frames of one recording, then of another with the same camera, without telemetry."""

    def decode(problems: list[Problem]) -> Iterator[Frame]:
        both = chain.from_iterable(islice(one.decode(problems), count) for one in (first, second))
        return (ChangedFrame(frame, i, i / rate_hz) for i, frame in enumerate(both))

    return replace(first, decode=decode, length=2 * count, telemetry=[], groundtruth=None)


def backwards(recording: Recording, images: Sequence[ImageEntry]) -> Recording:
    """The last image first, without telemetry; its ground truth must be reversed the same way.

    Args:
        recording: As it was taken.
        images: Its files in time order.
    """
    stamps = mirrored_stamps_s(np.array([entry.stamp_s for entry in images]))
    turned = [ImageEntry(i, float(stamps[-1 - i]), e.path) for i, e in enumerate(reversed(images))]
    size = recording.camera.width, recording.camera.height

    def decode(problems: list[Problem]) -> Iterator[Frame]:
        return frames_of(turned, size, problems)

    return replace(recording, decode=decode, length=len(turned), telemetry=[], groundtruth=None)


def mirrored_stamps_s(stamps_s: FloatArray) -> FloatArray:
    """Time-reversed stamps ``(F,)`` over the same interval."""
    return stamps_s[0] + stamps_s[-1] - stamps_s


def made_of(images: Callable[[int], NDArray[np.uint8]], count: int, camera: Camera, rate_hz: float) -> Recording:
    """A recording of ``count`` images ``(H, W, 3)`` that a function makes from their numbers."""

    def decode(_: list[Problem]) -> Iterator[Frame]:
        return (Frame(i, i / rate_hz, images(i)) for i in range(count))

    return Recording("made up", "images", "made up", camera, decode, count)


def _picked(recording: Recording, pick: Callable[[Iterator[Frame]], Iterator[Frame]], length: int | None) -> Recording:
    def decode(problems: list[Problem]) -> Iterator[Frame]:
        for i, frame in enumerate(pick(recording.decode(problems))):
            yield ChangedFrame(frame, i, frame.stamp_s)

    return replace(recording, decode=decode, length=length)


def _divided_up(length: int | None, step: int) -> int | None:
    return None if length is None else -(-length // step)
