"""A bag as a recording: pictures with stamps, calibration, telemetry."""

import copy
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import SourceError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.imu import ImuReadings
from edgeslam_torch.readers.bags.bag import Bag
from edgeslam_torch.readers.bags.camera_info import camera_from_info
from edgeslam_torch.readers.bags.clock import Offset, TopicClock, disagree, header_s, measure
from edgeslam_torch.readers.bags.imu import read_bag_imu
from edgeslam_torch.readers.bags.pictures import PictureDecoder
from edgeslam_torch.readers.bags.telemetry import read_bag_telemetry
from edgeslam_torch.readers.bags.topics import Choice, choose
from edgeslam_torch.readers.levels import Levels, levels_of
from edgeslam_torch.readers.listing import Problem
from edgeslam_torch.types import Frame, TelemetrySample

_LOOKED_AT = 20
"""Messages at the start of a topic by which its clock is judged."""


@dataclass(frozen=True, slots=True)
class BagRecording:
    """What a run needs of a bag."""

    bag: Bag
    choice: Choice
    size: tuple[int, int]
    """``(width, height)`` of its first picture [px]."""
    count: int
    """Messages of the camera."""
    camera: Camera | None
    """By its ``CameraInfo``; None without a usable one."""
    telemetry: list[TelemetrySample]
    remarks: tuple[str, ...]
    """One line each, for the user."""
    offset: Offset
    """Of the pictures' header stamps."""
    levels: Levels | None
    """Of pictures of more than eight bits."""
    clocks: Mapping[str, TopicClock] = field(default_factory=dict)
    """Of the IMU's topics."""

    def imu(self) -> tuple[ImuReadings | None, list[str]]:
        """Readings of the IMU, None without one; and remarks."""
        return read_bag_imu(self.bag, self.choice.imu, copy.deepcopy(self.clocks))

    def frames(self, problems: list[Problem]) -> Iterator[Frame]:
        """Pictures with increasing stamps, read a chunk of the file at a time; skipped ones go to ``problems``."""
        name = self.choice.image
        label = f"{self.bag.path.name}:{name}"
        decoder, clock = PictureDecoder(label, self.levels), TopicClock(self.offset.value_s, self.offset.fault is None)
        last = -math.inf
        for index, raw in enumerate(self.bag.messages([name])):
            where = f"{label}, picture {index}"
            try:
                message = self.bag.decode(raw)
                stamp = clock.stamp(raw.received_s, header_s(message))
                image = decoder.decode(message)
            except SourceError as error:
                problems.append(Problem(where, str(error).removeprefix(f"{label}: ")))
                continue
            size = (image.shape[1], image.shape[0])
            if size != self.size or stamp <= last:
                odd = f"image is {size[0]}x{size[1]}, the others are {self.size[0]}x{self.size[1]}"
                reason = odd if size != self.size else f"stamp {stamp:.6f} does not increase"
                problems.append(Problem(where, f"{reason}; image left out"))
                continue
            last = stamp
            yield Frame(index, stamp, image)
        if clock.mended:
            reason = f"{clock.mended} header stamps jump; the times between receipts were used for them"
            problems.append(Problem(label, reason, frames=0))


def open_bag(path: Path, topics: Sequence[str] = (), calibrated: bool = False) -> BagRecording:
    """Choose topics and clock, and read calibration and telemetry.

    Args:
        path: File, or folder of a ROS 2 recording.
        topics: As given to ``--topic``.
        calibrated: Whether the calibration comes from elsewhere, so that the bag's is not read.

    Raises:
        SourceError: If the file cannot be read, or the camera is not clear.
        CalibrationError: If our lens model cannot express its calibration.
        MissingPackageError: If rosbags is not installed.
    """
    bag = Bag(path)
    choice = choose(bag, topics)
    count = next(topic.count for topic in bag.topics if topic.name == choice.image)
    remarks = list(choice.remarks)
    camera = None if calibrated else _camera(bag, choice, remarks)
    size, levels = _first_look(bag, choice.image)
    if levels is not None:
        remarks.append(f"{choice.image}: more than 8 bits: {levels.words}")
    offset, clocks = _clocks(bag, choice, remarks)
    of_imu = {name: copy.copy(clocks[name]) for name in choice.imu}
    telemetry, said = read_bag_telemetry(bag, choice.telemetry, choice.asked, clocks)
    for name, clock in clocks.items():
        if clock.mended:
            remarks.append(f"{name}: {clock.mended} header stamps jump; the times between receipts were used for them")
    return BagRecording(bag, choice, size, count, camera, telemetry, (*remarks, *said), offset, levels, of_imu)


def _camera(bag: Bag, choice: Choice, remarks: list[str]) -> Camera | None:
    first = [] if choice.camera is None else bag.first(choice.camera, 1)
    if not first or choice.camera is None:
        return None
    rectified = "rect" in choice.image.removesuffix("/compressed").rpartition("/")[2]
    camera, said = camera_from_info(first[0][1], f"{bag.path.name}:{choice.camera}", rectified)
    remarks += said
    if camera is None:
        remarks.append(f"{choice.camera}: an empty calibration (all zeros), so it is not used")
    return camera


def _first_look(bag: Bag, name: str) -> tuple[tuple[int, int], Levels | None]:
    """Size of most pictures among the first `_LOOKED_AT`, and levels of those of more than eight bits."""
    decoder = PictureDecoder(f"{bag.path.name}:{name}")
    sizes: list[tuple[int, int]] = []
    faults: list[str] = []

    def deep() -> Iterator[NDArray[Any]]:
        for raw in islice(bag.messages([name]), _LOOKED_AT):
            try:
                message = bag.decode(raw)
                picture, _code = decoder.pixels(message)
                height, width = decoder.decode(message).shape[:2]
            except SourceError as error:
                faults.append(str(error))
                continue
            sizes.append((width, height))
            if picture.dtype != np.uint8:
                yield picture

    pictures = deep()
    first = next(pictures, None)
    levels = None if first is None else levels_of(chain([first], pictures))
    for _ in pictures:  # the sizes of the others
        pass
    if not sizes:
        raise SourceError(faults[0] if faults else f"{bag.path}: {name} holds no message")
    return Counter(sizes).most_common(1)[0][0], levels


def _clocks(bag: Bag, choice: Choice, remarks: list[str]) -> tuple[Offset, dict[str, TopicClock]]:
    """The pictures' clock, and one clock a telemetry topic on the same time."""
    offsets = {
        name: measure([(raw.received_s, header_s(message)) for raw, message in bag.first(name, _LOOKED_AT)])
        for name in {choice.image, *choice.telemetry.values(), *choice.imu}
    }
    of_image = offsets[choice.image]
    if of_image.fault is not None:
        remarks.append(f"{choice.image}: {of_image.fault}; times of receipt are used")
    elif of_image.other_epoch:
        remarks.append(
            f"{choice.image}: header stamps are {abs(of_image.value_s) / 86400:.0f} days off the times of receipt; "
            "they are used as they are"
        )
    clocks = {}
    for name in dict.fromkeys((*choice.telemetry.values(), *choice.imu)):
        offset = offsets[name]
        fault = offset.fault
        if fault is None and disagree(offset, of_image):
            apart_s = abs(offset.value_s - of_image.value_s)
            fault = f"header stamps are {apart_s:.3g} s apart from those of {choice.image}"
        if fault is not None and fault != "has no header stamps" and fault != of_image.fault:
            remarks.append(f"{name}: {fault}; times of receipt are used for it")
        clocks[name] = TopicClock(of_image.value_s, fault is None)
    return of_image, clocks
