"""Recording of a flight that is consistent at any moment, also after a crash."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2

from edgeslam_torch.drone.tello import StateMessage
from edgeslam_torch.errors import EdgeSlamError, OutputError
from edgeslam_torch.files.appender import Appender
from edgeslam_torch.files.plain import subfolder, write_image
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.readers.telemetry_csv import TelemetryWriter
from edgeslam_torch.types import Frame
from edgeslam_torch.writers.own_folder import check_free

_JPEG_QUALITY = 95
_FILES = ("camera.yaml", "state.txt", "moments.csv", "exits.csv", "plan.jsonl")
"""Of recorded flights, beside those that mark a recording."""


class FlightWriter:
    """A TUM-layout folder: ``rgb/``, ``rgb.txt``, ``camera.yaml``, ``telemetry.csv``, ``state.txt`` (raw lines).

    Each picture is written before its line in ``rgb.txt``, and lines are written whole: every listed picture exists,
    and partial writes are removed.
    """

    def __init__(self, folder: Path, camera: Camera, with_telemetry: bool, lossless: bool = False) -> None:
        """Make the folder.

        Raises:
            OutputError: If it holds a recording or a run already, or cannot be written.
        """
        self.folder = folder
        self.frames = self.states = 0
        self._suffix = "png" if lossless else "jpg"
        self._options = [] if lossless else [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        check_free(folder, _FILES, lambda _: False, "give another folder")
        try:
            subfolder(folder, "rgb")
            save_camera(folder / "camera.yaml", camera)
            self._list = Appender(folder / "rgb.txt", "# stamp_s file\n")
            self._raw = Appender(folder / "state.txt", "") if with_telemetry else None
            self._telemetry = TelemetryWriter(folder / "telemetry.csv") if with_telemetry else None
        except (OSError, EdgeSlamError) as error:
            raise OutputError(f"{folder}: cannot be written: {_reason(error)}") from error

    def add_frame(self, frame: Frame) -> None:
        """Write one picture.

        Raises:
            OutputError: If writing fails; the recording is unchanged.
        """
        name = f"rgb/{frame.stamp_s:.6f}.{self._suffix}"
        path = self.folder / name

        def write() -> None:
            write_image(path, frame.image, self._options)
            self._list.write(f"{frame.stamp_s:.6f} {name}\n")

        try:
            _guarded(path, write)
        except OutputError:
            with suppress(OSError):
                path.unlink(missing_ok=True)  # partial picture that is not listed
            raise
        self.frames += 1

    def add_state(self, message: StateMessage) -> None:
        """Write one state message.

        Raises:
            OutputError: If the file cannot be written.
        """
        if self._raw is None or self._telemetry is None:
            return
        raw, telemetry = self._raw, self._telemetry
        _guarded(telemetry.path, lambda: telemetry.write(message.stamp_s, message.fields))
        _guarded(self.folder / "state.txt", lambda: raw.write(f"{message.stamp_s:.6f} {message.raw}\n"))
        self.states += 1

    def close(self) -> None:
        """Close the files."""
        for file in (self._list, self._raw, self._telemetry):
            if file is not None:
                file.close()

    def __enter__(self) -> "FlightWriter":
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()


def _guarded(path: Path, write: Callable[[], None]) -> None:
    try:
        write()
    except (OSError, EdgeSlamError, cv2.error) as error:
        raise OutputError(f"{path}: cannot be written: {_reason(error)}") from error


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
