"""The output folder of ``edgeslam run``, read back."""

import csv
import io
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import match
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, read_trajectory
from edgeslam_torch.files.record_files import read_mapping, recording_of
from edgeslam_torch.files.tables import read_text
from edgeslam_torch.readers.layouts import read_sequence
from edgeslam_torch.types import PointCloud
from edgeslam_torch.writers.ply import read_ply
from edgeslam_torch.writers.run_summary import vertical_text

_NUMBERS = ("stamp_s", "scale", "scale_sigma", "unit", "revision")
"""Columns of ``status.csv`` that are read as numbers; empty where a run has none."""
_SUPPORTED = frozenset({"initialised", "tracked", "relocalised"})
"""Status of a frame whose pose rests on the map, in tables of version 0.1, which have no column for it."""


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Contents of a run folder; missing parts are None or empty."""

    path: Path
    trajectory: Trajectory
    online: Trajectory | None
    status: tuple[dict[str, str], ...]
    """Rows of ``status.csv``."""
    summary: dict[str, Any]

    @property
    def name(self) -> str:
        """Folder name."""
        return self.path.resolve().name

    @property
    def scale(self) -> dict[str, Any]:
        """What the run says of its scale; empty for a bare trajectory."""
        return record(self.summary.get("scale"))

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale's logarithm, as stated by the run; NaN when it states none."""
        return number(self.scale.get("sigma")) / (number(self.scale.get("value")) or math.nan)

    @property
    def units(self) -> str:
        """``metres`` or ``arbitrary``, as stated by the run; ``unknown`` when it states none."""
        return str(self.scale.get("units", "unknown"))

    @property
    def up(self) -> str:
        """Source of gravity (``telemetry``, ``edges``, ...); ``unknown`` when nothing does, or an older run does
        not say."""
        return str(record(self.summary.get("up")).get("source", "unknown"))

    @property
    def vertical(self) -> str:
        """The same in a sentence, with its standard deviation."""
        return vertical_text(self.summary.get("up"))

    def cloud(self, name: str = "edge_map.ply") -> PointCloud | None:
        """Point cloud of the folder, None when it is not there."""
        file = self.path / name
        return read_ply(file) if file.is_file() else None

    def keyframe_poses(self) -> list[int]:
        """Poses of ``trajectory`` that are keyframes; every tenth without that column in ``status.csv``."""
        index = [k for k, row in enumerate(self.pose_rows) if is_keyframe(row)]
        return index or list(range(0, len(self.trajectory), 10))

    @property
    def source(self) -> Path | None:
        """Input folder of the run, if named in its summary and still present; relative to the run's folder."""
        folder = recording_of(self.path, self.summary)
        try:
            return folder if folder is not None and folder.is_dir() else None
        except (OSError, ValueError):  # an impossible folder name
            return None

    @property
    def own_truth(self) -> Path | None:
        """Ground truth of the recording that the run read, when it is still there, or in the run's own folder."""
        folder = self.source
        if folder is not None and _has_truth(folder):
            return folder
        files = (self.path / name for name in ("groundtruth.txt", "ground_truth.txt"))
        return next((file for file in files if file.is_file()), None)

    @property
    def pose_rows(self) -> tuple[dict[str, str], ...]:
        """Row of ``status.csv`` for each pose of ``trajectory``, empty where there is none; of a run in pieces the
        others' rows are left out."""
        if len(self.status) == len(self.trajectory):
            return self.status
        stamps = np.array([float(row.get("stamp_s") or "inf") for row in self.status] or [np.inf])
        order = np.argsort(stamps, kind="stable")
        found = dict(zip(*match(self.trajectory.stamps_s, stamps[order], 1e-3), strict=True))
        return tuple(self.status[order[found[k]]] if k in found else {} for k in range(len(self.trajectory)))

    @property
    def trusted_frames(self) -> int:
        """Poses of ``trajectory`` supported by the map; all without ``status.csv``."""
        return sum(map(is_supported, self.pose_rows)) if self.status else len(self.trajectory)


def open_run(path: Path | str) -> RunFolder:
    """Run folder, or a single trajectory file taken as one.

    Raises:
        EvaluationError: If it holds no trajectory or a part is malformed.
    """
    path = Path(path)
    if path.is_file():
        return RunFolder(path, read_trajectory(path), None, (), {})
    if not path.exists():
        raise EvaluationError(f"{path}: no such run folder or trajectory file")
    online, summary = path / "trajectory_online.txt", path / "summary.json"
    return RunFolder(
        path,
        read_trajectory(path),
        read_trajectory(online) if online.is_file() else None,
        read_status(path / "status.csv"),
        read_mapping(summary, "JSON", EvaluationError) if summary.is_file() else {},
    )


def _has_truth(recording: Path) -> bool:
    """Whether true poses lie in the folder, or where its layout has them."""
    if (recording / "groundtruth.txt").is_file():
        return True
    try:
        sequence = read_sequence(recording)
    except EdgeSlamError:  # damaged since the run
        return False
    return sequence is not None and sequence.groundtruth is not None


def number(value: object) -> float:
    """A value of a file that may hold anything as a number; NaN if it is none, or not finite."""
    try:
        found = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return math.nan
    return found if math.isfinite(found) else math.nan


def record(value: object) -> dict[str, Any]:
    """The same as a record; empty if it is none."""
    return value if isinstance(value, dict) else {}


def is_keyframe(row: dict[str, str]) -> bool:
    """Whether a row of ``status.csv`` is a keyframe's."""
    return row.get("keyframe", "").lower() in ("1", "true", "yes")


def is_supported(row: dict[str, str]) -> bool:
    """Whether a row of ``status.csv`` has a final pose supported by the map."""
    stated = row.get("supported", "")
    return stated == "1" if stated else row.get("status", "") in _SUPPORTED


def read_status(path: Path) -> tuple[dict[str, str], ...]:
    """Rows of ``status.csv``; empty when there is none.

    Raises:
        EvaluationError: If it is not a table of text, or a cell that is a number in every run is none.
    """
    if not path.is_file():
        return ()
    lines = io.StringIO(read_text(path, EvaluationError), newline="")
    try:
        rows = tuple({k: v or "" for k, v in row.items() if k is not None} for row in csv.DictReader(lines))
        for row in rows:
            for name in _NUMBERS:
                float(row.get(name) or "nan")
    except (ValueError, csv.Error) as error:
        raise EvaluationError(f"{path}: not the table of a run ({error})") from error
    return rows
