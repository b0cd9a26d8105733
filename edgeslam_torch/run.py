"""Run the SLAM system on a source and write the results to a folder: ``edgeslam run``."""

import gc
import importlib
import logging
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from itertools import islice
from pathlib import Path
from types import FrameType, ModuleType
from typing import TYPE_CHECKING, Any, Protocol

from edgeslam_torch.calibration.camera_choice import GUESS, GUESS_COST, GUESS_WARNING
from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.config_file import to_toml
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.imu import ImuModel, Reading
from edgeslam_torch.readers.flight_folder import telemetry_gap
from edgeslam_torch.readers.pace import Counter, ReadingsCursor, at_their_pace
from edgeslam_torch.readers.read_ahead import read_ahead
from edgeslam_torch.readers.source import Source
from edgeslam_torch.types import (
    FloatArray,
    Frame,
    Observations,
    Piece,
    PointCloud,
    Record,
    ScaleEstimate,
    SlamOutput,
    Support,
)
from edgeslam_torch.writers.map_picture import write_map_picture
from edgeslam_torch.writers.observations import write_observations
from edgeslam_torch.writers.run_summary import Tally, summarise, up_in_words, without_folders
from edgeslam_torch.writers.run_writer import CAMERA, OBSERVATIONS, PICTURE, SUMMARY, RunWriter, summary_text

if TYPE_CHECKING:
    from edgeslam_torch.atlas.saved import SavedAtlas

logger = logging.getLogger(__name__)

_HANG_UP: int = getattr(signal, "SIGHUP", 0)  # Windows has none
_STOPPING = [number for number in (signal.SIGINT, signal.SIGTERM, _HANG_UP) if number]

LOOKED_AT = 320
"""Images at the start of a recording used to estimate an unknown focal length; ten seconds at 30 Hz."""


class Mode(StrEnum):
    """How frames are fed to the system."""

    OFFLINE = "offline"
    """Sequentially, without dropped frames; the output is reproducible to the byte."""
    REALTIME = "realtime"
    """In real time by their stamps; frames that cannot be processed in time are dropped and counted."""


class Slam(Protocol):
    """The part of `EdgeSlam` that the loop uses."""

    @property
    def events(self) -> dict[str, int]: ...

    def prepare(self, frame: Frame) -> Any:
        """Feature extraction that does not depend on earlier frames."""

    def step(self, frame: Frame, readings: Sequence[Reading] = (), prepared: Any = None) -> SlamOutput:
        """Pose of one frame."""

    def finish(self) -> None:
        """Run the last refinement."""

    def close(self) -> None:
        """Stop background threads."""

    def trajectory(self) -> tuple[FloatArray, FloatArray]:
        """Stamps ``(F,)`` and refined ``T_w_c`` ``(F, 4, 4)``."""

    def edge_map(self) -> PointCloud:
        """Semi-dense map."""

    def anchors(self) -> PointCloud:
        """Triangulated anchors."""

    def observations(self) -> Observations:
        """Observations of the anchors in keyframes."""

    def keyframes(self) -> Sequence[Any]:
        """Keyframes in the map."""

    def telemetry_statistics(self) -> dict[str, float]:
        """Telemetry statistics; empty without telemetry."""

    def losses(self) -> dict[str, float]:
        """Losses of the final map by name; empty before `finish`."""

    def support(self) -> Support:
        """Evidence for each frame's final pose."""

    def pieces(self) -> list[Piece]:
        """Submaps that the frames belong to."""

    def joins(self) -> Sequence[Any]:
        """Merged submaps; ``str`` gives the evidence."""

    def closures(self) -> Sequence[Any]:
        """Closed loops; ``str`` gives the evidence."""

    def warnings(self) -> list[str]:
        """Limitations of the results, one line each."""

    def load_atlas(self, saved: "SavedAtlas") -> None:
        """Load the map of earlier flights."""

    def saved_atlas(self, flight: str) -> "SavedAtlas":
        """The map for the next flight."""

    def earlier_flights(self) -> dict[str, Any] | None:
        """Statistics of the loaded atlas."""

    @property
    def scale(self) -> ScaleEstimate:
        """Metres per map unit."""


class Listener(Protocol):
    """Observer of a run: a progress bar, a viewer."""

    def on_frame(self, frame: Frame, output: SlamOutput, slam: Slam) -> None:
        """Called after every step, in the loop's thread."""

    def on_finish(self, slam: Slam) -> None:
        """Called once, after the last refinement, before the results are written.

        A listener with a method ``on_last_frame(slam)`` is also called before the last refinement.
        """


@dataclass(frozen=True, slots=True)
class AtlasFiles:
    """Map to load and file to save the map to."""

    load: "SavedAtlas | None" = None
    """Map of earlier flights; None for none."""
    save: Path | None = None
    """File to write the map to at the end; None for none."""


@dataclass(frozen=True, slots=True, repr=False)
class RunResult(Record):
    """Result of a run."""

    folder: Path
    summary: dict[str, Any]
    """Content of ``summary.json``."""
    stamps_s: FloatArray
    """``(F,)``"""
    T_w_c: FloatArray
    """``(F, 4, 4)`` refined."""
    interrupted: bool
    """Whether it was ended by Ctrl-C."""
    failure: str | None
    """Error of output that could not be written; None without errors."""


def run(
    source: Source,
    out_dir: str | Path,
    config: SlamConfig | None = None,
    mode: Mode = Mode.OFFLINE,
    listeners: Sequence[Listener] = (),
    make_slam: Callable[[Camera, SlamConfig, bool], Slam] | None = None,
    atlas: "AtlasFiles | None" = None,
) -> RunResult:
    """Run the SLAM system over a source and write its folder.

    If the run ends early (Ctrl-C, full disk, lost live source), trajectory, map and summary of the processed frames
    are written.

    Args:
        source: From `open_source`.
        out_dir: Folder for the results; created if missing. An older run in it is replaced after the first frame.
        config: Settings; the defaults when None.
        mode: How frames are fed.
        listeners: Called after every frame.
        make_slam: Builds the system from camera, settings and whether it runs in real time; `EdgeSlam` when None.
        atlas: Map to load and file to save the map to; none by default.

    Raises:
        TypeError: If it is no source, or no settings.
        OutputError: If the folder is not writable, contains files that no run wrote, or is in use by another run.
        SourceError: If the source provides no frame, or fails during the run (after the results are written).
    """
    if not hasattr(source, "frames"):
        raise TypeError(f"a source is expected, got {type(source).__name__}: open_source(PATH)")
    if config is not None and not isinstance(config, SlamConfig):
        raise TypeError(f"a SlamConfig is expected, got {type(config).__name__}")
    config, atlas = config or SlamConfig(), atlas or AtlasFiles()
    with closing(source), closing(RunWriter(Path(out_dir), [Path(source.location)], to_toml(config))) as writer:
        slam = (make_slam or partial(_edge_slam, imu=source.imu))(source.camera, config, mode is Mode.REALTIME)
        if atlas.load is not None:
            slam.load_atlas(atlas.load)
        return _Run(source, writer, slam, config, mode, listeners, atlas).go()


def settle_camera(source: Source) -> None:
    """Replace a guessed focal length by an estimate from the first images, or store the reason for its absence.

    Not for live sources, whose images cannot be read twice.
    """
    if source.live or not source.camera.source.startswith(GUESS):
        return
    from edgeslam_torch.tracking.self_calibration import MAX_FRAMES, guess_camera

    looked_at = min(source.length or LOOKED_AT, LOOKED_AT)
    frames = source.frames()
    images = [frame.image for frame in islice(frames, 0, looked_at, max(1, looked_at // MAX_FRAMES))]
    close = getattr(frames, "close", None)
    if close is not None:
        close()
    if not images:
        return
    source.camera = guess_camera(images, source.camera.width, source.camera.height)
    if not source.camera.source.startswith(GUESS):
        source.warnings[:] = [w for w in source.warnings if not w.startswith(GUESS_WARNING)]
        source.warnings.append(f"no calibration found: {source.camera.source}; {GUESS_COST}")


class _Run:
    """One run over a source."""

    def __init__(
        self,
        source: Source,
        writer: RunWriter,
        slam: Slam,
        config: SlamConfig,
        mode: Mode,
        listeners: Sequence[Listener],
        atlas: "AtlasFiles",
    ) -> None:
        self.source = source
        self.writer = writer
        self.slam = slam
        self.config = config
        self.mode = mode
        self.listeners = listeners
        self.atlas = atlas
        self.tally = Tally()
        self.dropped = Counter()
        self.interrupt = _Interrupt()
        self.error: BaseException | None = None
        """The first one, raised when the results are written."""
        self.result: RunResult | None = None
        self.last_index: int | None = None

    def go(self) -> RunResult:
        wall, cpu = time.perf_counter(), time.process_time()
        with self.interrupt:
            with self._error_kept():
                self._loop()
            if self.tally.frames:
                self._write(time.perf_counter() - wall, cpu)
        if self.error is not None:
            raise self.error
        if self.result is None:
            raise SourceError(self._no_frame())
        return self.result

    @contextmanager
    def _error_kept(self, stopped: str = "") -> Iterator[None]:
        """What fails here does not cost the results so far; ``stopped`` is logged after a Ctrl-C."""
        try:
            yield
        except BaseException as error:  # libraries turn a Ctrl-C into others
            if not self.interrupt.raised:
                self.error = self.error or error
            elif stopped:
                logger.warning(stopped)
            self.interrupt.raised = False

    def _ended_early(self) -> str | None:
        if self.interrupt.requested:
            return "interrupted"
        if self.error is not None:
            return " ".join(str(self.error).split()) or type(self.error).__name__
        return self.writer.failure

    def _loop(self) -> None:
        frames = self.source.frames()
        if self.mode is Mode.REALTIME and not self.source.live:
            frames = at_their_pace(frames, self.dropped)
        prepared = self._prepared(frames)
        readings = ReadingsCursor(self.source)
        try:
            while (item := self._next(prepared)) is not None:
                frame, features = item
                self._count_missed(frame)
                started = time.perf_counter()
                output = self.slam.step(frame, readings.until(frame.stamp_s), features)
                step_ms = 1e3 * (time.perf_counter() - started)
                self.tally.add(output, step_ms)
                if not self.writer.append(output, step_ms, self._image_name(frame)):
                    return
                for listener in self.listeners:
                    listener.on_frame(frame, output, self.slam)
        finally:
            prepared.close()

    def _image_name(self, frame: Frame) -> str:
        """The frame's file, relative to the recording's folder."""
        if frame.path is None:
            return ""
        whole = frame.path.parent.resolve() / frame.path.name
        return (
            str(whole.relative_to(self.source.location))
            if whole.is_relative_to(self.source.location)
            else frame.path.name
        )

    def _prepared(self, frames: Iterator[Frame]) -> Generator[tuple[Frame, Any]]:
        """Frames with their features; for recordings, a second thread extracts the next ones."""
        ahead = not self.source.live

        def pairs() -> Generator[tuple[Frame, Any]]:
            try:
                for frame in frames:
                    yield frame, self.slam.prepare(frame) if ahead else None
            finally:
                close = getattr(frames, "close", None)
                if close is not None:
                    close()

        return read_ahead(pairs()) if ahead else pairs()

    def _count_missed(self, frame: Frame) -> None:
        """Count skipped images of a live source, which appear as gaps in the index."""
        if self.source.live and self.last_index is not None:
            self.dropped.value += max(0, frame.index - self.last_index - 1)
        self.last_index = frame.index

    def _next(self, frames: Iterator[tuple[Frame, Any]]) -> tuple[Frame, Any] | None:
        """The next frame with its features; None at the end or on a stop request, which interrupts a source that
        blocks."""
        if self.interrupt.requested:
            return None
        self.interrupt.at_once = True
        try:
            return next(frames, None)
        finally:
            self.interrupt.at_once = False

    def _write(self, loop_s: float, cpu_start_s: float) -> None:
        started = time.perf_counter()
        with self._error_kept():
            for listener in self.listeners:
                if hasattr(listener, "on_last_frame"):
                    listener.on_last_frame(self.slam)
        with self._error_kept("stopped before the last refinement finished"):
            self.slam.finish()
        self.interrupt.writing = True
        finish_s = time.perf_counter() - started
        self.slam.close()  # results are consistent afterwards, even if the refinement was interrupted
        stamps, poses = self.slam.trajectory()
        edge_map, anchors, scale = self.slam.edge_map(), self.slam.anchors(), self.slam.scale
        up = getattr(self.slam, "up", None)
        with self._error_kept():
            for listener in self.listeners:
                listener.on_finish(self.slam)
        saved = None if self.atlas.save is None else self.slam.saved_atlas(self.source.name)
        cpu_s = time.process_time() - cpu_start_s
        summary = {
            **summarise(
                self.source, self.tally, self.slam.pieces(), scale, self.dropped.value, loop_s, finish_s, cpu_s
            ),
            "up": up_in_words(up),
            "warnings": [*self.source.warnings, *self.slam.warnings(), *self._telemetry_gap(stamps)],
            "map": {
                "keyframes": len(self.slam.keyframes()),
                "anchors": len(anchors.p_w),
                "edge_points": len(edge_map.p_w),
            },
            "losses": {k: v for k, v in self.slam.losses().items() if math.isfinite(v)},
            "events": dict(self.slam.events),
            "joins": [str(join) for join in self.slam.joins()],
            "loops": [str(closure) for closure in self.slam.closures()],
            "atlas": None if self.atlas.load is None else self.slam.earlier_flights(),
            "saved_atlas": None if saved is None else saved.summary(),
            "fusion": {k: v for k, v in self.slam.telemetry_statistics().items() if math.isfinite(v)},
            "mode": str(self.mode),
            "seed": self.config.seed,
            "interrupted": self.interrupt.requested,
            "ended_early": self._ended_early(),
        }
        summary = without_folders(summary, self.writer.folder)
        support = self.slam.support()
        title = f"{self.source.name}: {self.tally.frames} frames, {len(edge_map.p_w)} edge points"

        def picture(path: Path) -> None:
            write_map_picture(path, edge_map, poses[support.whole()], scale.units, title, up is not None)

        extras = [
            (CAMERA, lambda path: save_camera(path, self.source.camera)),
            (OBSERVATIONS, lambda path: write_observations(path, self.slam.observations())),
            (PICTURE, picture),
        ]
        if saved is not None and self.atlas.save is not None:
            from edgeslam_torch.atlas.atlas_file import write_atlas

            extras.append((str(self.atlas.save.resolve()), lambda path: write_atlas(path, saved)))
        missing = self.writer.finish(summary, stamps, poses, support, edge_map, anchors, scale.units, extras)
        atlas = None if self.atlas.save is None else str(self.atlas.save.resolve())
        if atlas is not None and any(line.startswith(atlas) for line in missing):
            summary["saved_atlas"] = None  # the entry was set before writing failed
            with suppress(OSError):
                write_text(self.writer.folder / SUMMARY, summary_text(summary))
        self.result = RunResult(
            self.writer.folder, summary, stamps, poses, self.interrupt.requested, self.writer.failure
        )

    def _telemetry_gap(self, stamps_s: FloatArray) -> list[str]:
        gap = telemetry_gap(self.source.telemetry, float(stamps_s[0]), float(stamps_s[-1]))
        return [] if gap is None else [gap]

    def _no_frame(self) -> str:
        if self.interrupt.requested:
            return f"{self.source.name}: interrupted before the first frame; nothing was written"
        first = self.source.problems[0] if self.source.problems else None
        why = f" ({first.file}: {first.reason})" if first is not None else ""
        return f"{self.source.name}: provided no frame{why}"


class _Interrupt:
    """Ctrl-C, a closed terminal or ``kill`` request a stop: the run ends and writes its results.

    A second Ctrl-C interrupts the main thread at once, for example during the last refinement, except while writing.
    """

    def __init__(self) -> None:
        self.requested = False
        self.at_once = False
        """Whether the main thread may be interrupted at once because it only waits."""
        self.writing = False
        self.raised = False
        """Whether the main thread was interrupted, and what that raised is not yet caught."""
        self._old: dict[int, Any] = {}

    def __enter__(self) -> "_Interrupt":
        if threading.current_thread() is threading.main_thread():
            for number in _STOPPING:
                self._old[number] = signal.signal(number, self._on_signal)
            if self._old.get(_HANG_UP) is signal.SIG_IGN:  # nohup
                signal.signal(_HANG_UP, signal.SIG_IGN)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._old.items():
            signal.signal(number, handler)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        again = self.requested and number == signal.SIGINT  # a closing terminal may send its signal twice
        self.requested = True
        if self.at_once or (again and not self.writing):
            self.raised = True
            raise KeyboardInterrupt


def _edge_slam(camera: Camera, config: SlamConfig, realtime: bool, imu: ImuModel | None = None) -> Slam:
    if "edgeslam_torch.slam" not in sys.modules:
        _load_slam()
    from edgeslam_torch.slam import EdgeSlam

    return EdgeSlam(camera, config, realtime=realtime, imu=imu)


def _load_slam() -> None:
    """Import the system, and freeze the garbage collector afterwards: what was loaded stays."""
    was_on = gc.isenabled()
    gc.disable()
    try:
        importlib.import_module("edgeslam_torch.slam")
    finally:
        gc.freeze()
        if was_on:
            gc.enable()


class _CallableModule(ModuleType):
    """Makes this module callable as its function `run`, since both have the name ``edgeslam_torch.run``."""

    __call__ = staticmethod(run)


sys.modules[__name__].__class__ = _CallableModule
