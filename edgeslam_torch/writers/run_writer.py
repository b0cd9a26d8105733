"""The output folder of a run: appended to during the run, rewritten with refined results at the end."""

import csv
import json
import math
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from io import StringIO
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

import numpy as np

from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.appender import Appender
from edgeslam_torch.files.atomic import remove_partials, write_text
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray, PointCloud, SlamOutput, Support, Units
from edgeslam_torch.writers.own_folder import STATUS, SUMMARY, FolderLock, check_free
from edgeslam_torch.writers.ply import write_ply
from edgeslam_torch.writers.run_summary import vertical_text

TRAJECTORY = "trajectory.txt"
ONLINE = "trajectory_online.txt"
EDGE_MAP = "edge_map.ply"
ANCHORS = "anchors.ply"
CONFIG = "config.toml"
CAMERA = "camera.yaml"
OBSERVATIONS = "observations.npz"
PICTURE = "map.png"
PIECE = "trajectory_piece_{}.txt"
"""Of pieces that were never joined with the largest, which is in `TRAJECTORY`."""
OUTPUTS = (
    *(TRAJECTORY, ONLINE, STATUS, EDGE_MAP, ANCHORS, SUMMARY),
    *(CONFIG, CAMERA, OBSERVATIONS, PICTURE, "report.html"),
)


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


_COLUMNS: dict[str, Callable[[SlamOutput], str]] = {
    "index": lambda output: str(output.index),
    "stamp_s": lambda output: f"{output.stamp_s:.6f}",
    "status": lambda output: str(output.status),
    "reason": lambda output: output.reason,
    "matches": lambda output: str(output.matches),
    "inliers": lambda output: str(output.inliers),
    "parallax_deg": lambda output: _number(math.degrees(output.parallax_rad), 4),
    "keyframe": lambda output: str(int(output.keyframe)),
    "piece": lambda output: str(output.piece),
    "supported": lambda output: str(int(output.status.supported)),
    "scale": lambda output: _number(output.scale.value, 6),
    "scale_sigma": lambda output: _number(output.scale.sigma, 6),
    "scale_source": lambda output: output.scale.source,
    "metric": lambda output: str(int(output.metric)),
    "revision": lambda output: str(output.revision),
    "unit": lambda output: _number(output.unit, 6),
}
STATUS_COLUMNS = (*_COLUMNS, "step_ms", "image")
"""Columns of ``status.csv``, followed by one column ``<stage>_ms`` per stage."""

TRAJECTORY_HEADER = "# stamp_s tx ty tz qx qy qz qw, camera to world\n"

_OLD_RESERVE = ".reserve"
"""Reserve file left by killed runs of version 0.1."""
_RESERVE_BYTES = 24 << 20
"""Disk space reserved for the final files: a map of 400 000 points (12 MB), two trajectories, a picture."""


class RunWriter:
    """Writes one run's folder.

    An older run is kept until the first frame. After a write error (full disk) nothing more is appended, existing
    files stay valid, and `failure` has the reason; the reserved space still allows the final files to be written.
    """

    def __init__(self, folder: Path, keep: Iterable[Path] = (), config_toml: str = "") -> None:
        """Create and lock the folder, and reserve space.

        Args:
            folder: Folder of the results.
            keep: Folders that must not be written to, such as the source, or files in such ones.
            config_toml: The resolved configuration, written beside the results.

        Raises:
            OutputError: If the folder cannot be made or written to, is one to keep, holds files that no run wrote, or
                another run writes into it.
        """
        self.folder = folder
        self.failure: str | None = None
        self._config_toml = config_toml
        self._live: _LiveFiles | None = None
        try:
            self._made = not folder.exists()
            folder.mkdir(parents=True, exist_ok=True)
            if any(folder.samefile(other.parent if other.is_file() else other) for other in keep if other.exists()):
                raise OutputError(f"{folder}: is the source itself; give another folder to --out")
            check_free(folder, OUTPUTS)
            self._lock = FolderLock(folder)
            try:
                self._reserve = _held_back(folder)
            except OSError:
                self._lock.release()
                raise
        except OSError as error:
            raise OutputError(f"{folder}: cannot write results there ({error.strerror or error})") from error

    def append(self, output: SlamOutput, step_ms: float, image: str = "") -> bool:
        """Add one frame, with the name of its image file, to the trajectories and the status table; False after a write
        error."""
        if self.failure is not None:
            return False
        try:
            if self._live is None:
                self._live = self._begun()
            self._live.add(output, step_ms, image)
        except OSError as error:
            self.failure = f"{self.folder}: cannot write any more ({error.strerror or error})"
            return False
        return True

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
        """Write the refined results, the most important first.

        Args:
            summary: For ``summary.json``.
            stamps_s: ``(F,)`` stamps of the refined trajectory [s].
            T_w_c: ``(F, 4, 4)`` refined poses, camera to world.
            support: What supports them, for the columns ``piece`` and ``supported`` of ``status.csv``.
            edge_map: Semi-dense map in the same world frame.
            anchors: Triangulated anchors.
            units: Of all of these.
            extras: File names and functions that write them, such as the picture.

        Returns:
            Failures, one line each.
        """
        self._reserve.close()
        comments = (
            f"units: {units}",
            f"frame: world of trajectory.txt, {vertical_text(summary.get('up'))}",
            "sigma: standard deviation along the ray",
        )
        rows = [tum_line(stamp, T) for stamp, T in zip(stamps_s, T_w_c, strict=True)]
        whole = [row for row, inside in zip(rows, support.whole(), strict=True) if inside]
        live = self._live
        steps: list[tuple[str, Callable[[Path], None]]] = [
            (TRAJECTORY, lambda path: write_text(path, TRAJECTORY_HEADER + "".join(whole))),
            *(_piece_file(number, rows, support) for number in support.others()),
            (STATUS, lambda path: live.settle(support) if live is not None else None),
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
        """Close files, release lock and reserved space, and remove a folder that stayed empty."""
        if self._live is not None:
            self._live.close()
        self._reserve.close()
        self._lock.release()
        if self._made and self._live is None:
            with suppress(OSError):
                self.folder.rmdir()

    def _begun(self) -> "_LiveFiles":
        """Remove the files of an older run, and open this run's files."""
        for name in (*OUTPUTS, *(f".{name}.part" for name in OUTPUTS), _OLD_RESERVE):
            (self.folder / name).unlink(missing_ok=True)
        for path in self.folder.glob(PIECE.format("*")):
            path.unlink(missing_ok=True)
        remove_partials(self.folder)
        live = _LiveFiles(self.folder)
        write_text(self.folder / CONFIG, self._config_toml)
        return live


class _LiveFiles:
    """Files that grow with every frame: the live trajectories and the status table."""

    def __init__(self, folder: Path) -> None:
        self._table = folder / STATUS
        self._stages: list[str] = []
        self._status = Appender(self._table, _csv_line(STATUS_COLUMNS))
        self._trajectory = Appender(folder / TRAJECTORY, TRAJECTORY_HEADER)
        self._online = Appender(folder / ONLINE, TRAJECTORY_HEADER)

    def add(self, output: SlamOutput, step_ms: float, image: str) -> None:
        line = tum_line(output.stamp_s, output.T_w_c)
        self._trajectory.write(line)
        self._online.write(line)
        self._write_status(output, step_ms, image)

    def close(self) -> None:
        for file in (self._trajectory, self._online, self._status):
            file.close()

    def _write_status(self, output: SlamOutput, step_ms: float, image: str) -> None:
        new = [stage for stage in output.stage_ms if stage not in self._stages]
        if new:  # columns for stages that ran later
            self._stages += new
            self._rewrite_status(self._status_rows())
        stages = [_number(output.stage_ms.get(stage, math.nan), 3) for stage in self._stages]
        known = [text(output) for text in _COLUMNS.values()]
        self._status.write(_csv_line([*known, _number(step_ms, 3), image, *stages]))

    def settle(self, support: Support) -> None:
        """Replace each frame's live support by that of its final pose."""
        rows = self._status_rows()
        piece, supported = STATUS_COLUMNS.index("piece"), STATUS_COLUMNS.index("supported")
        for row, number, good in zip(rows, support.piece, support.supported, strict=False):
            row[piece], row[supported] = str(number), str(int(good))
        self._rewrite_status(rows)

    def _status_rows(self) -> list[list[str]]:
        self._status.close()
        with self._table.open(newline="", encoding="utf-8") as file:
            return list(csv.reader(file))[1:]

    def _rewrite_status(self, rows: list[list[str]]) -> None:
        header = [*STATUS_COLUMNS, *(f"{stage}_ms" for stage in self._stages)]
        padded = [_csv_line(row + [""] * (len(header) - len(row))) for row in rows]
        try:
            write_text(self._table, _csv_line(header) + "".join(padded))
        finally:
            self._status = Appender(self._table, None)


def _piece_file(number: int, rows: Sequence[str], support: Support) -> tuple[str, Callable[[Path], None]]:
    """Name and writer of the trajectory of a piece whose place in the others is unknown."""
    mine = "".join(row for row, piece in zip(rows, support.piece, strict=True) if piece == number)
    return PIECE.format(number), lambda path: write_text(path, TRAJECTORY_HEADER + mine)


def tum_line(stamp_s: float, T_w_c: FloatArray) -> str:
    """``stamp tx ty tz qx qy qz qw`` of one pose, camera to world."""
    return f"{stamp_s:.6f} " + " ".join(f"{x:.9f}" for x in se3.pose_to_tum(T_w_c)) + "\n"


def summary_text(summary: dict[str, Any]) -> str:
    """Strict JSON: non-finite numbers become null."""
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


def _csv_line(cells: Sequence[str]) -> str:
    buffer = StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(cells)
    return buffer.getvalue()


def _held_back(folder: Path) -> IO[bytes]:
    """Reserved disk space, freed when the anonymous file is closed or the process dies.

    Fast where the file system can allocate without writing.
    """
    file = TemporaryFile(dir=folder)  # noqa: SIM115, closed by the writer
    try:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, _RESERVE_BYTES)
        else:
            file.write(bytes(_RESERVE_BYTES))
    except OSError:
        file.close()
        raise
    return file
