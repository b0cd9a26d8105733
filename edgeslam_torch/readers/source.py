"""`open_source`: a recording, an image folder, a video or a live stream as frames with a camera."""

import difflib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import Protocol

from edgeslam_torch.calibration.camera_choice import choose_camera
from edgeslam_torch.errors import SourceError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.imu import ImuModel, ImuReadings, Reading
from edgeslam_torch.readers import flight_folder, images, video
from edgeslam_torch.readers.bags.bag import SUFFIXES, is_bag
from edgeslam_torch.readers.bags.recording import open_bag
from edgeslam_torch.readers.imu.find import NONE, Given, Imu, find_imu
from edgeslam_torch.readers.layouts import layout_of, read_sequence, tum
from edgeslam_torch.readers.listing import ImageEntry, Problem
from edgeslam_torch.readers.pace import Steps
from edgeslam_torch.readers.read_ahead import read_ahead
from edgeslam_torch.readers.sequence import Sequence as ImageSequence
from edgeslam_torch.readers.telemetry_csv import read_telemetry
from edgeslam_torch.types import Frame, TelemetrySample

LIVE_SCHEMES = ("tello://", "webcam:", "rtsp://", "udp://", "http://", "https://", "gst:")

ARCHIVES = (".zip", ".tgz", ".gz", ".tar", ".7z")
_FEW = 3
"""Fewer images are no recording: a calibration's vignette, a title picture."""
PANORAMAS = (".insv", ".360")
"""Raw files of Insta360 and GoPro cameras: two fisheye pictures side by side."""


class Source(Protocol):
    """Interface of a source, recorded or live."""

    name: str
    """Name for messages and file names."""
    kind: str
    """A layout's ``KIND``, or ``images``, ``video``, ``flight``, ``bag``, ``live``."""
    location: str
    """Absolute path, or the address of a live source."""
    camera: Camera
    telemetry: list[TelemetrySample]
    """Telemetry in time order; grows during a live run."""
    imu: ImuModel | None
    """Of the IMU beside the camera; None without one."""
    imu_readings: ImuReadings | None
    """Of the whole recording."""
    groundtruth: Path | None
    length: int | None
    """Maximum number of frames; None if unknown."""
    problems: list[Problem]
    """Skipped items so far, with reasons."""
    warnings: list[str]
    """Warnings about the source."""
    live: bool
    """Whether frames arrive at their own rate and are dropped if not taken."""

    def frames(self) -> Iterator[Frame]:
        """Frames in time order."""

    def steps(self) -> Iterator[tuple[Frame, list[Reading]]]:
        """Each frame with the readings since the one before."""

    def close(self) -> None:
        """Release the device; may be called repeatedly."""


@dataclass(repr=False)
class Recording(Steps):
    """A source on disk; `frames` may be called repeatedly."""

    name: str
    kind: str
    location: str
    camera: Camera
    decode: Callable[[list[Problem]], Iterator[Frame]]
    """Frames, decoded on demand; appends skipped ones to ``problems``."""
    count: int | None
    """Frames that `decode` gives at most; None if unknown."""
    telemetry: list[TelemetrySample] = field(default_factory=list)
    groundtruth: Path | None = None
    problems: list[Problem] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    live: bool = False
    max_frames: int | None = None
    start: int = 0
    """Number of skipped frames at the start."""
    stride: int = 1
    """Interval of used frames among the others."""
    imu: ImuModel | None = None
    imu_readings: ImuReadings | None = None
    length: int | None = field(init=False)

    def __post_init__(self) -> None:
        self._listed = tuple(self.problems)
        chosen = None if self.count is None else len(range(self.start, self.count, self.stride))
        self.length = min((number for number in (chosen, self.max_frames) if number is not None), default=None)

    def frames(self) -> Iterator[Frame]:
        """Frames in time order; the next one is decoded while the caller works on this one."""
        self.problems[:] = self._listed
        chosen = islice(self.decode(self.problems), self.start, None, self.stride)
        return read_ahead(islice(chosen, self.max_frames))

    def part(self, start: int, stride: int) -> "Recording":
        """Every ``stride``-th frame from number ``start`` on, and no readings from before a second ahead of them.

        Raises:
            SourceError: If there is no frame so late.
        """
        first = next(islice(self.decode([]), start, None), None)
        if first is None:
            raise SourceError(f"{self.location}: no frame from number {start} on")
        telemetry = [sample for sample in self.telemetry if sample.stamp_s >= first.stamp_s - 1.0]
        readings = None if self.imu_readings is None else self.imu_readings.between(first.stamp_s - 1.0, math.inf)
        return replace(self, start=start, stride=stride, telemetry=telemetry, imu_readings=readings)

    def close(self) -> None:
        """Nothing to release."""


@dataclass(frozen=True, slots=True)
class _Content:
    """Contents of a source before a camera is chosen."""

    kind: str
    decode: Callable[[tuple[int, int], list[Problem]], Iterator[Frame]]
    size: tuple[int, int]
    length: int | None
    problems: list[Problem]
    folder: Path
    groundtruth: Path | None = None
    default_camera: Camera | None = None
    own_camera: Camera | None = None
    """Calibration inside the recording."""
    telemetry: tuple[TelemetrySample, ...] = ()
    """Telemetry inside the recording."""
    imu: Callable[[], tuple[ImuReadings | None, list[str]]] = lambda: (None, [])
    """Readings of an IMU inside the recording, and remarks."""
    stamps_s: tuple[float, float] | None = None
    """Of the first and the last frame, if known without decoding."""

    def span_s(self) -> tuple[float, float]:
        """Stamps of the first and the last frame; of a video, infinity in place of the last."""
        if self.stamps_s is not None:
            return self.stamps_s
        first = next(self.decode(self.size, []), None)
        return (0.0 if first is None else first.stamp_s), math.inf


def open_source(
    spec: str | Path,
    camera: str | Path | None = None,
    telemetry: str | Path | None = None,
    max_frames: int | None = None,
    topics: Sequence[str] = (),
    imu: str | Path | None = None,
    imu_model: str | Path | None = None,
) -> Source:
    """Open the source that ``spec`` names.

    Args:
        spec: A TUM-layout, 7-Scenes, EuRoC or image folder, a video file, a flight recording, a ROS bag, or a live
            source (``tello://HOST``, ``webcam:0``, ``rtsp://...``, ``http://...``, ``gst:PIPELINE``).
        camera: Calibration file or preset; default: the source's own.
        telemetry: ``telemetry.csv`` of the flight; default: the source's own.
        max_frames: Maximum number of frames.
        topics: Of a ROS bag, see `edgeslam_torch.readers.bags.topics.choose`.
        imu: Readings of an IMU, or ``none``; default: the source's own.
        imu_model: Its noise, mount and clock; default: the files beside the readings and the calibration.

    Raises:
        SourceError: If there is nothing usable; the message names the file and what to do.
        CalibrationError: If the calibration does not fit.
        MissingPackageError: If the source needs a package that is not installed.
    """
    if max_frames is not None and max_frames < 1:
        raise SourceError(f"max_frames must be at least 1, got {max_frames}")
    if str(spec).startswith(LIVE_SCHEMES):
        if topics:
            raise SourceError(f"{spec}: --topic is for ROS bags ({', '.join(SUFFIXES)})")
        if imu not in (None, NONE) or imu_model is not None:
            raise SourceError(f"{spec}: an IMU's file is for recordings; give step() its readings in Python")
        return _open_live(str(spec), camera, telemetry, max_frames)
    path = Path(spec).expanduser()
    if path.exists() and is_bag(path):
        content = _bag_content(path, topics, camera is not None)
    elif topics:
        raise SourceError(f"{path}: --topic is for ROS bags ({', '.join(SUFFIXES)})")
    else:
        content = _content(path)
    images.check_trackable(content.size, path)
    folders = [path, content.folder] if path.is_dir() else [content.folder]
    own_files = (folder / flight_folder.TELEMETRY for folder in folders)
    telemetry_file = _file(telemetry, "--telemetry") or next((file for file in own_files if file.is_file()), None)
    samples, remarks = (list(content.telemetry), []) if telemetry_file is None else read_telemetry(telemetry_file)
    model, readings, imu_warnings = _imu_of(content, folders, imu, imu_model, camera)
    default = content.default_camera
    chosen, warnings = choose_camera(content.size, camera, folders, default, bool(samples), content.own_camera)
    return Recording(
        name=path.resolve().name,
        kind="flight" if samples and content.kind in ("tum", "video") else content.kind,
        location=str(path.resolve()),
        camera=chosen,
        decode=lambda problems: content.decode(content.size, problems),
        count=content.length,
        telemetry=samples,
        groundtruth=content.groundtruth,
        problems=content.problems,
        warnings=[*warnings, *remarks, *imu_warnings],
        max_frames=max_frames,
        imu=model,
        imu_readings=readings,
    )


def _imu_of(
    content: _Content,
    folders: Sequence[Path],
    imu: str | Path | None,
    imu_model: str | Path | None,
    camera: str | Path | None,
) -> Imu:
    """The IMU that was named, else the recording's own."""
    if imu == NONE:
        return None, None, []
    inside, said = content.imu() if imu is None else (None, [])
    given = Given(_file(imu, "--imu"), _file(imu_model, "--imu-model"), None if camera is None else Path(camera))
    model, readings, remarks = find_imu(folders, given, content.span_s, inside)
    return model, readings, [*said, *remarks]


def _file(given: str | Path | None, option: str) -> Path | None:
    """A file that the user named."""
    path = None if given is None else Path(given).expanduser()
    if path is not None and not path.is_file():
        raise SourceError(f"{option} {path}: no such file")
    return path


def frames_without_camera(path: Path, problems: list[Problem]) -> Iterator[Frame]:
    """Frames of a recording whose calibration is neither needed nor read.

    Raises:
        SourceError: As `open_source`.
    """
    content = _bag_content(path, (), True) if path.exists() and is_bag(path) else _content(path)
    problems += content.problems
    return content.decode(content.size, problems)


def _content(path: Path) -> _Content:
    try:
        if path.is_dir():
            return _folder_content(path)
        if path.is_file():
            return _file_content(path)
    except OSError as error:
        raise SourceError(f"{error.filename or path}: {error.strerror or error}") from error
    if path.exists():
        raise SourceError(f"{path}: neither a file nor a folder")
    there = [other.name for other in path.parent.iterdir()] if path.parent.is_dir() else []
    close = difflib.get_close_matches(path.name, there, n=1, cutoff=0.8)
    hint = f"; did you mean {path.parent / close[0]}?" if close else ""
    raise SourceError(f"{path}: no such file or folder{hint}")


def _file_content(path: Path) -> _Content:
    suffix = path.suffix.lower()
    if suffix in images.SUFFIXES:
        return _listed(ImageSequence("images", path.parent, (ImageEntry(0, 0.0, path),)), path)
    if suffix in ARCHIVES:
        raise SourceError(f"{path}: an archive: unpack it first, then give the folder")
    if suffix in PANORAMAS:
        raise SourceError(f"{path}: a raw panorama; export a flat video of one direction in its maker's program")
    if path.name in tum.LISTS:
        return _folder_content(path.parent)
    return _video_content(path, None)


def _bag_content(path: Path, topics: Sequence[str], calibrated: bool) -> _Content:
    bag = open_bag(path, topics, calibrated)
    return _Content(
        "bag",
        lambda _, problems: bag.frames(problems),
        bag.size,
        bag.count,
        [Problem(path.name, remark, frames=0) for remark in bag.remarks],
        path if path.is_dir() else path.parent,
        own_camera=bag.camera,
        telemetry=tuple(bag.telemetry),
        imu=bag.imu,
    )


def _folder_content(folder: Path) -> _Content:
    sequence = read_sequence(folder)
    if sequence is not None:
        return _listed(sequence, sequence.folder)
    truth = folder / "groundtruth.txt" if (folder / "groundtruth.txt").is_file() else None
    recorded = flight_folder.find_video(folder)
    if recorded is not None:
        return _video_content(recorded, truth)
    found, problems = images.list_image_folder(folder)
    below = (child for child in sorted(folder.iterdir()) if child.is_dir() and not child.name.startswith("."))
    inside = {child.name: len(images.image_files(child)) for child in below} if len(found) < _FEW else {}
    if found and inside and max(inside.values()) > len(found):
        more = max(inside, key=lambda name: inside[name])
        raise SourceError(
            f"{folder}: {len(found)} image(s), but {inside[more]} in its folder {more}; give one of the two"
        )
    return _listed(ImageSequence("images", folder, tuple(found), tuple(problems), truth), folder)


def _video_content(path: Path, groundtruth: Path | None) -> _Content:
    stamps, problems = flight_folder.video_stamps(path)
    clip = video.Video(path, stamps)
    if clip.rate_is_assumed:
        reason = f"a raw stream holds no times: {clip.rate_hz:g} images/s are assumed; put it into .mp4 with its rate"
        problems.append(Problem(str(path), reason, frames=0))

    def decode(_: tuple[int, int], problems: list[Problem]) -> Iterator[Frame]:
        return clip.frames(problems)

    return _Content("video", decode, clip.size, clip.count, problems, path.parent, groundtruth)


def _listed(sequence: ImageSequence, place: Path) -> _Content:
    """Images of a sequence that was found in ``place``, which messages name."""
    if not sequence.images:
        raise SourceError(_nothing_in(place))
    return _Content(
        sequence.kind,
        lambda size, found: images.frames_of(sequence.images, size, found),
        images.usual_size(sequence.images, str(place)),
        len(sequence.images),
        list(sequence.problems),
        sequence.folder,
        sequence.groundtruth,
        sequence.camera,
        stamps_s=(sequence.images[0].stamp_s, sequence.images[-1].stamp_s),
    )


def _nothing_in(folder: Path) -> str:
    """Error for a folder that is no source, with a suggestion."""
    children = sorted(folder.iterdir()) if folder.is_dir() else []
    if not children:
        return f"{folder}: empty; give a folder of images, a TUM, 7-Scenes or EuRoC sequence, or a video"
    folders = (child for child in children if child.is_dir())
    sequences = [child.name for child in folders if layout_of(child) is not None or images.image_files(child)]
    if sequences:
        more = ", ..." if len(sequences) > 5 else ""
        names = ", ".join(sequences[:5]) + more
        return f"{folder}: holds no images itself, but these folders in it do: {names}; give one of them"
    suffixes = sorted({child.suffix.lower() or child.name for child in children})
    found = ", ".join(suffixes[:5])
    return f"{folder}: no images or video in it (found {found}); images must be .png or .jpg"


def _open_live(spec: str, camera: str | Path | None, telemetry: str | Path | None, max_frames: int | None) -> Source:
    """Open a live source, which needs sockets and (for a drone) the ``[drone]`` extra."""
    if telemetry is not None:
        raise SourceError(f"{spec}: a live source brings its own telemetry; omit --telemetry")
    from edgeslam_torch.readers.live import open_live

    return open_live(spec, camera, max_frames)
