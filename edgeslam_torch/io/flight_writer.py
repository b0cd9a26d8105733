"""Recording of a flight that is whole at any moment: what was written before a crash can be read."""

from pathlib import Path
from typing import TextIO

import cv2

from edgeslam_torch.errors import OutputError
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.io.telemetry_csv import TelemetryWriter
from edgeslam_torch.io.tello import StateMessage
from edgeslam_torch.types import Frame

_JPEG_QUALITY = 95


class FlightWriter:
    """A TUM-layout folder: ``rgb/``, ``rgb.txt``, ``camera.yaml``, ``telemetry.csv``, ``state.txt`` (raw lines).

    Each picture is written before its line in ``rgb.txt``, each line is flushed: nothing is listed that is not there.
    """

    def __init__(self, folder: Path, camera: Camera, with_telemetry: bool, lossless: bool = False) -> None:
        """Make the folder.

        Raises:
            OutputError: If it holds a recording already or cannot be written.
        """
        self.folder = folder
        self.frames = self.states = 0
        self._suffix = "png" if lossless else "jpg"
        self._options = [] if lossless else [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        if (folder / "rgb.txt").exists():
            raise OutputError(f"{folder}: holds a recording already; give another --out")
        try:
            (folder / "rgb").mkdir(parents=True, exist_ok=True)
            camera.save(folder / "camera.yaml")
            self._list: TextIO = (folder / "rgb.txt").open("w", encoding="utf-8", newline="\n")
            self._list.write("# stamp_s file\n")
            self._raw: TextIO | None = None
            self._telemetry: TelemetryWriter | None = None
            if with_telemetry:
                self._raw = (folder / "state.txt").open("w", encoding="utf-8", newline="\n")
                self._telemetry = TelemetryWriter(folder / "telemetry.csv")
        except OSError as error:
            raise OutputError(f"{folder}: cannot be written: {error.strerror or error}") from error

    def add_frame(self, frame: Frame) -> None:
        """Write one picture.

        Raises:
            OutputError: If the disk refuses.
        """
        name = f"rgb/{frame.stamp_s:.6f}.{self._suffix}"
        ok, data = cv2.imencode(f".{self._suffix}", frame.image, self._options)
        try:
            if not ok:
                raise OSError(f"cannot encode as {self._suffix}")
            (self.folder / name).write_bytes(data.tobytes())
            self._list.write(f"{frame.stamp_s:.6f} {name}\n")
            self._list.flush()
        except OSError as error:
            raise OutputError(f"{self.folder / name}: cannot be written: {error.strerror or error}") from error
        self.frames += 1

    def add_state(self, message: StateMessage) -> None:
        """Write one state message.

        Raises:
            OutputError: If the disk refuses.
        """
        if self._raw is None or self._telemetry is None:
            return
        try:
            self._raw.write(f"{message.stamp_s:.6f} {message.raw}\n")
            self._raw.flush()
        except OSError as error:
            raise OutputError(f"{self.folder / 'state.txt'}: cannot be written: {error.strerror or error}") from error
        self._telemetry.write(message.stamp_s, message.fields)
        self.states += 1

    def close(self) -> None:
        """Close the files."""
        self._list.close()
        if self._raw is not None:
            self._raw.close()
        if self._telemetry is not None:
            self._telemetry.close()

    def __enter__(self) -> "FlightWriter":
        return self

    def __exit__(self, *unused: object) -> None:
        self.close()
