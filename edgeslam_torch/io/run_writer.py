"""The output folder of a run: appended to while it goes, rewritten with refined results at the end."""

import csv
import json
import math
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.atomic import write_text
from edgeslam_torch.errors import OutputError
from edgeslam_torch.geometry import se3
from edgeslam_torch.io.ply import write_ply
from edgeslam_torch.types import FloatArray, PointCloud, SlamOutput, Support, Units

TRAJECTORY = "trajectory.txt"
ONLINE = "trajectory_online.txt"
STATUS = "status.csv"
EDGE_MAP = "edge_map.ply"
ANCHORS = "anchors.ply"
SUMMARY = "summary.json"
CONFIG = "config.toml"
CAMERA = "camera.yaml"
PICTURE = "map.png"
OUTPUTS = (TRAJECTORY, ONLINE, STATUS, EDGE_MAP, ANCHORS, SUMMARY, CONFIG, CAMERA, PICTURE, "report.html")

STATUS_COLUMNS = (
    "index",
    "stamp_s",
    "status",
    "reason",
    "matches",
    "inliers",
    "parallax_deg",
    "keyframe",
    "piece",
    "supported",
    "scale",
    "scale_sigma",
    "scale_source",
    "step_ms",
)
"""Of ``status.csv``; one column ``<stage>_ms`` for every stage follows."""

TRAJECTORY_HEADER = "# stamp_s tx ty tz qx qy qz qw, camera to world\n"

_RESERVE = ".reserve"
_RESERVE_BYTES = 24 << 20
"""Held back from the disk for the final files: a map of 400 000 points (12 MB), two trajectories, a picture."""


class RunWriter:
    """Writes one run's folder.

    After a write error (a full disk) nothing more is appended, what is there stays valid, and `failure` says what
    happened; the space that was held back lets the final files still be written.
    """

    def __init__(self, folder: Path, keep: Iterable[Path] = ()) -> None:
        """Make the folder and take away what an older run left in it.

        Args:
            folder: Where the results go.
            keep: Folders that the results must not go into, such as the source.

        Raises:
            OutputError: If the folder cannot be made or written to, or is one to keep.
        """
        self.folder = folder
        self.failure: str | None = None
        self._stages: list[str] = []
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.samefile(other) for other in keep if other.exists()):
                raise OutputError(f"{folder}: is the source itself; give another folder to --out")
            for name in OUTPUTS:
                (folder / name).unlink(missing_ok=True)
            _reserve(folder / _RESERVE)
            self._trajectory = _Appender(folder / TRAJECTORY, TRAJECTORY_HEADER)
            self._online = _Appender(folder / ONLINE, TRAJECTORY_HEADER)
            self._status = _Appender(folder / STATUS, _csv_line(STATUS_COLUMNS))
        except OSError as error:
            with suppress(OSError):
                (folder / _RESERVE).unlink(missing_ok=True)
            raise OutputError(f"{folder}: cannot write results there ({error.strerror or error})") from error

    def append(self, output: SlamOutput, step_ms: float) -> bool:
        """Add one frame to the trajectories and the status table; False when nothing can be written any more."""
        if self.failure is not None:
            return False
        try:
            line = tum_line(output.stamp_s, output.T_w_c)
            self._trajectory.write(line)
            self._online.write(line)
            self._write_status(output, step_ms)
        except OSError as error:
            self._fail(error)
            return False
        return True

    def write_config(self, toml: str) -> None:
        """Put the resolved configuration beside the results."""
        self._guarded(lambda: write_text(self.folder / CONFIG, toml))

    def finish(
        self,
        summary: dict[str, Any],
        stamps_s: FloatArray,
        T_w_c: FloatArray,
        support: Support,
        edge_map: PointCloud,
        anchors: PointCloud,
        units: Units,
        extras: Sequence[tuple[str, Callable[[Path], None]]] = (),
    ) -> list[str]:
        """Write the refined results, the most valuable first.

        Args:
            summary: For ``summary.json``.
            stamps_s: ``(F,)`` stamps of the refined trajectory [s].
            T_w_c: ``(F, 4, 4)`` refined poses, camera to world.
            support: What they rest on, for the columns ``piece`` and ``supported`` of ``status.csv``.
            edge_map: Semi-dense map in the same world frame.
            anchors: Triangulated anchors.
            units: Of all of these.
            extras: File names and functions that make them, such as the picture.

        Returns:
            What could not be written, one line each.
        """
        (self.folder / _RESERVE).unlink(missing_ok=True)
        comments = (
            f"units: {units}",
            "frame: world of trajectory.txt, z up",
            "sigma: standard deviation along the ray",
        )
        rows = "".join(tum_line(stamp, T) for stamp, T in zip(stamps_s, T_w_c, strict=True))
        steps: list[tuple[str, Callable[[Path], None]]] = [
            (TRAJECTORY, lambda path: write_text(path, TRAJECTORY_HEADER + rows)),
            (STATUS, lambda path: self._settle_status(support)),
            (SUMMARY, lambda path: write_text(path, summary_text(summary))),
            (EDGE_MAP, lambda path: write_ply(path, edge_map, comments)),
            (ANCHORS, lambda path: write_ply(path, anchors, comments)),
            *extras,
        ]
        missing = []
        for name, write in steps:
            try:
                write(self.folder / name)
            except OSError as error:
                missing.append(f"{name} ({error.strerror or error})")
        if missing and self.failure is None:
            self.failure = f"{self.folder}: could not write {', '.join(missing)}"
        return missing

    def close(self) -> None:
        """Give back files and the space held back."""
        for file in (self._trajectory, self._online, self._status):
            file.close()
        (self.folder / _RESERVE).unlink(missing_ok=True)

    def _write_status(self, output: SlamOutput, step_ms: float) -> None:
        new = [stage for stage in output.stage_ms if stage not in self._stages]
        if new:
            self._stages += new
            self._widen_status()
        stages = [_number(output.stage_ms.get(stage, math.nan), 3) for stage in self._stages]
        self._status.write(_csv_line([*_status_row(output, step_ms), *stages]))

    def _widen_status(self) -> None:
        """Rewrite the table so far with columns for stages that had not run before."""
        self._rewrite_status(self._status_rows())

    def _settle_status(self, support: Support) -> None:
        """Say of every frame what its final pose rests on, in place of what its pose rested on when it came."""
        rows = self._status_rows()
        piece, supported = STATUS_COLUMNS.index("piece"), STATUS_COLUMNS.index("supported")
        for row, number, good in zip(rows, support.piece, support.supported, strict=False):
            row[piece], row[supported] = str(number), str(int(good))
        self._rewrite_status(rows)

    def _status_rows(self) -> list[list[str]]:
        self._status.close()
        with (self.folder / STATUS).open(newline="", encoding="utf-8") as file:
            return list(csv.reader(file))[1:]

    def _rewrite_status(self, rows: list[list[str]]) -> None:
        header = [*STATUS_COLUMNS, *(f"{stage}_ms" for stage in self._stages)]
        padded = [_csv_line(row + [""] * (len(header) - len(row))) for row in rows]
        path = self.folder / STATUS
        try:
            write_text(path, _csv_line(header) + "".join(padded))
        finally:
            self._status = _Appender(path, None)

    def _guarded(self, write: Callable[[], None]) -> None:
        try:
            write()
        except OSError as error:
            self._fail(error)

    def _fail(self, error: OSError) -> None:
        self.failure = f"{self.folder}: cannot write any more ({error.strerror or error})"


class _Appender:
    """A text file that holds whole lines only, whatever the disk does."""

    def __init__(self, path: Path, header: str | None) -> None:
        self._file = path.open("ab" if header is None else "wb", buffering=0)
        self._good = self._file.seek(0, os.SEEK_END)
        if header is not None:
            self.write(header)

    def write(self, text: str) -> None:
        data = text.encode("utf-8")
        try:
            written = self._file.write(data)
            if written != len(data):
                raise OSError(28, "no space left on device")
        except OSError:
            self._file.truncate(self._good)
            raise
        self._good += len(data)

    def close(self) -> None:
        self._file.close()


def tum_line(stamp_s: float, T_w_c: FloatArray) -> str:
    """``stamp tx ty tz qx qy qz qw`` of one pose, camera to world."""
    return f"{stamp_s:.6f} " + " ".join(f"{x:.9f}" for x in se3.pose_to_tum(T_w_c)) + "\n"


def summary_text(summary: dict[str, Any]) -> str:
    """JSON that every reader takes: numbers that are not finite become null."""
    return json.dumps(_plain(summary), indent=2, ensure_ascii=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, (bool, int, str)) or value is None:
        return value
    if isinstance(value, np.integer):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if math.isfinite(value) else None
    return str(value)


def _status_row(output: SlamOutput, step_ms: float) -> list[str]:
    return [
        str(output.index),
        f"{output.stamp_s:.6f}",
        str(output.status),
        output.reason,
        str(output.matches),
        str(output.inliers),
        _number(math.degrees(output.parallax_rad), 4),
        str(int(output.keyframe)),
        str(output.piece),
        str(int(output.status.supported)),
        _number(output.scale.value, 6),
        _number(output.scale.sigma, 6),
        output.scale.source,
        _number(step_ms, 3),
    ]


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


def _csv_line(cells: Sequence[str]) -> str:
    buffer = StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)
    return buffer.getvalue()


def _reserve(path: Path) -> None:
    """Take space on the disk; quick where the file system can promise space without writing it."""
    with path.open("wb") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, _RESERVE_BYTES)
        else:
            file.write(bytes(_RESERVE_BYTES))
