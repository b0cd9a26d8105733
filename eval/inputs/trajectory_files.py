"""Trajectory files: TUM, EuRoC, KITTI and 7-Scenes are read, TUM is written.

All give poses of the camera in the world; those of a body whose camera is not known stay the body's. Every reader
refuses what cannot be a trajectory with one line that names the file and the likely mistake.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.columns import Columns, columns_by_name, columns_by_number
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.record_files import plain_yaml
from edgeslam_torch.files.tables import Table, read_table
from edgeslam_torch.files.time_units import UNKNOWN, seconds_of
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.rotations import matrices_from_quaternions, nearest_rotation
from edgeslam_torch.types import FloatArray
from edgeslam_torch.writers.run_writer import tum_line

SEVEN_SCENES_HZ = 30.0
"""The 7-Scenes files carry no stamps; the sensor ran at 30 Hz."""

ROWS, FRAMES = "rows", "frames"
"""What stamps were made up from (`Trajectory.numbered`)."""

_TIMES = "times.txt"
"""Stamps beside poses whose format has none, as KITTI has them."""

_EUROC = ("state_groundtruth_estimate0", "mocap0", "vicon0", "leica0")
"""Folders of an EuRoC or TUM-VI sequence with true poses: of the body, or of a marker that is mounted on it."""

_MAX_LENGTH = 1e12
"""Larger numbers are no positions: in millimetres, the way to the sun."""
_TOO_FEW_DIGITS = 0.3
"""Share of rows that repeat a stamp with another position from which the stamps are taken for rounded ones."""


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses over time."""

    stamps_s: FloatArray
    """``(N,)`` float64, strictly increasing."""
    T_w_c: FloatArray
    """``(N, 4, 4)`` camera to world, float64."""
    source: str = "trajectory"
    """File it came from, for messages."""
    notes: tuple[str, ...] = ()
    """What the reader corrected or assumed."""
    numbered: str = ""
    """`ROWS` or `FRAMES` when the file has no stamps and they were made up from the numbers of its rows or frames."""
    oriented: bool = True
    """False when the file gives positions alone: rotations are the identity then."""

    def __len__(self) -> int:
        return len(self.stamps_s)

    @property
    def stamped(self) -> bool:
        """Whether the stamps are the file's own."""
        return not self.numbered

    @property
    def positions(self) -> FloatArray:
        """Camera centres ``(N, 3)``."""
        return self.T_w_c[:, :3, 3]

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_] | slice) -> "Trajectory":
        """The poses at ``index``."""
        return replace(self, stamps_s=self.stamps_s[index], T_w_c=self.T_w_c[index])


def read_trajectory(path: Path | str, stamps_s: FloatArray | None = None) -> Trajectory:
    """Trajectory from a file or folder; the format is recognised by what is in it.

    Args:
        path: A TUM, EuRoC (``.csv``) or KITTI text file, a folder of 7-Scenes ``*.pose.txt``, or a run's or data
            set's folder that holds one of them under its usual name.
        stamps_s: Stamps of a KITTI file's rows ``(N,)`` [s]; a ``times.txt`` beside it is found by itself.

    Raises:
        EvaluationError: If there is no such file, or it is empty or malformed.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path)
    table = _read_table(path)
    count = len(table.rows[0].cells)
    try:
        columns = columns_by_name(table.header) if len(table.header) == count else None
    except EvaluationError as error:
        raise EvaluationError(f"{path}: {error}") from error
    if columns is None and count == 12:
        return _from_kitti(table.numbers(), path, stamps_s)
    columns = columns or columns_by_number(count, euroc=path.resolve().parent.name in _EUROC)
    if columns is None:
        raise EvaluationError(
            f"{path}: {count} column(s) from line {table.rows[0].line} on; TUM has 8 (t x y z qx qy qz qw), KITTI 12, "
            "EuRoC 17, positions alone 4, and other tables need a header that names the columns"
        )
    return _of_camera(_from_columns(table, columns, path), path)


def write_tum(trajectory: Trajectory, path: Path | str) -> None:
    """Write ``t tx ty tz qx qy qz qw``, camera to world."""
    rows = map(tum_line, trajectory.stamps_s, trajectory.T_w_c)
    write_text(Path(path), "# timestamp tx ty tz qx qy qz qw\n" + "".join(rows))


def _read_folder(folder: Path) -> Trajectory:
    names = (
        "trajectory.txt",
        "groundtruth.txt",
        "mav0/state_groundtruth_estimate0/data.csv",
        "state_groundtruth_estimate0/data.csv",
        "mav0/mocap0/data.csv",
        "mocap0/data.csv",
        "data.csv",
        "poses.txt",
    )
    for name in names:
        if (folder / name).is_file():
            return read_trajectory(folder / name)
    files = sorted(folder.glob("*.pose.txt"))
    if files:
        return _from_seven_scenes(files, folder)
    raise EvaluationError(f"{folder}: no trajectory in this folder (looked for {', '.join(names)}, *.pose.txt)")


def _read_table(path: Path) -> Table:
    """Rows of a text table, of which there is at least one."""
    table = read_table(path, EvaluationError)
    if table.rows:
        return table
    if table.header:
        raise EvaluationError(
            f"{path}: no line of numbers in it, the first is {' '.join(table.header)[:60]!r}; a TUM trajectory has "
            "'t x y z qx qy qz qw' on each line, between spaces or commas"
        )
    raise EvaluationError(f"{path}: the file holds no poses (did the run stop before its first frame?)")


def _from_columns(table: Table, columns: Columns, path: Path) -> Trajectory:
    """Trajectory from a table, cleaned and checked."""
    rotation = columns.quaternion or ()
    numbers = table.numbers([*columns.position, *rotation, *(index for index, _ in columns.time)])
    poses, time = np.split(numbers, [3 + len(rotation)], axis=1)
    stamps_s, notes = _seconds(time, [unit for _, unit in columns.time])
    stamps_s, poses = _finite(stamps_s, poses, str(path), notes)
    T: FloatArray = np.tile(np.eye(4), (len(poses), 1, 1))
    T[:, :3, 3] = columns.metres * poses[:, :3]
    if rotation:
        norms = np.linalg.norm(poses[:, 3:], axis=1)
        odd = np.abs(norms - 1.0) > 0.05  # files with three decimals stay within 0.005
        if odd.mean() > 0.5:
            raise EvaluationError(
                f"{path}: the last four numbers of a row are not a unit quaternion (norm {np.median(norms):.3g}); "
                "the order must be t x y z qx qy qz qw, or a header must name the columns"
            )
        if odd.any():
            notes.append(f"{np.count_nonzero(odd)} poses without a unit quaternion were left out")
        stamps_s, T = stamps_s[~odd], T[~odd]
        T[:, :3, :3] = matrices_from_quaternions(poses[~odd, 3:])
    stamps_s, T = _increasing(stamps_s, T, str(path), notes)
    return Trajectory(stamps_s, T, str(path), tuple(notes), oriented=columns.quaternion is not None)


def _finite(stamps_s: FloatArray, values: FloatArray, source: str, notes: list[str]) -> tuple[FloatArray, FloatArray]:
    """Poses, in any form ``(N, ...)``, without those that are not finite or of sizes that no length has."""
    finite = (np.abs(values) <= _MAX_LENGTH).reshape(len(values), -1).all(axis=1) & np.isfinite(stamps_s)
    if not finite.any():
        raise EvaluationError(f"{source}: every pose holds a NaN, an infinity or an absurdly large number")
    if not finite.all():
        notes.append(f"{np.count_nonzero(~finite)} of {len(values)} poses are not finite, or absurdly far: left out")
    return stamps_s[finite], values[finite]


def _seconds(time: FloatArray, units: Sequence[float | None]) -> tuple[FloatArray, list[str]]:
    """Stamps [s] from the columns that add up to them, and what was assumed of them."""
    if units[0] is not None:
        return time @ np.array(units, dtype=np.float64), []
    stamps_s, unit = seconds_of(time[:, 0])
    return stamps_s, [] if unit in ("s", UNKNOWN) else [f"the stamps are {unit}: converted to seconds"]


def _of_camera(mine: Trajectory, path: Path) -> Trajectory:
    """EuRoC's and TUM-VI's true poses, of the body or of a marker on it, as those of ``cam0``, which a run sees."""
    folder = path.resolve().parent
    if folder.name not in _EUROC:
        return mine
    T_b_c = _mount(folder.parent / "cam0" / "sensor.yaml")
    if T_b_c is None or not mine.oriented:
        why = "no cam0/sensor.yaml with T_BS beside it" if mine.oriented else "it has positions alone"
        note = f"the poses are those of {folder.name}'s body, not of the camera on it: {why}"
        return replace(mine, notes=(*mine.notes, note))
    T_b_s = _mount(folder / "sensor.yaml")
    T_s_c = T_b_c if T_b_s is None else se3.inverse(T_b_s) @ T_b_c
    note = "the body's poses were turned into cam0's (T_BS of its sensor.yaml)"
    return replace(mine, T_w_c=mine.T_w_c @ T_s_c, notes=(*mine.notes, note))


def _mount(sensor: Path) -> FloatArray | None:
    """``T_BS`` of an EuRoC ``sensor.yaml``, the sensor's pose on the body; None where there is none."""
    if not sensor.is_file():
        return None
    try:
        record = plain_yaml(sensor.read_text(encoding="utf-8"))
        if not isinstance(record, dict) or "T_BS" not in record:
            return None
        T_b_s = np.array(record["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise EvaluationError(f"{sensor}: T_BS, the sensor's pose on the body, cannot be read ({error})") from error
    R = T_b_s[:3, :3]
    if not np.isfinite(T_b_s).all() or np.abs(R @ R.T - np.eye(3)).max() > 0.01 or np.linalg.det(R) < 0:
        raise EvaluationError(f"{sensor}: T_BS, the sensor's pose on the body, is not a rotation and translation")
    return T_b_s


def _increasing(stamps_s: FloatArray, T: FloatArray, source: str, notes: list[str]) -> tuple[FloatArray, FloatArray]:
    """Poses in order of time, one a stamp."""
    steps = np.diff(stamps_s)
    if len(steps) and np.all(steps < 0):
        notes.append("the rows run backwards in time: sorted")
    elif np.any(steps < 0):
        notes.append(f"{np.count_nonzero(steps < 0)} rows are out of order in time: sorted")
    order = np.argsort(stamps_s, kind="stable")
    stamps_s, T = stamps_s[order], T[order]
    again = np.diff(stamps_s, prepend=-np.inf) <= 0
    moved = again & np.any(np.diff(T[:, :3, 3], axis=0, prepend=T[:1, :3, 3]) != 0, axis=1)
    if moved.sum() > _TOO_FEW_DIGITS * len(T):
        raise EvaluationError(
            f"{source}: {np.count_nonzero(moved)} of {len(T)} rows repeat a stamp ({stamps_s[again][0]:.6f}) with "
            "another pose: stamps written with too few digits; write microseconds, as '%.6f' does"
        )
    if again.any():
        notes.append(f"{np.count_nonzero(again)} row(s) repeat a stamp: the first of each was kept")
    return stamps_s[~again], T[~again]


def _from_matrices(stamps_s: FloatArray, T: FloatArray, source: str, notes: list[str]) -> Trajectory:
    stamps_s, T = _finite(stamps_s, T, source, notes)
    if np.median(np.abs(np.linalg.det(T[:, :3, :3]) - 1.0)) > 0.05:
        raise EvaluationError(f"{source}: the 3x3 parts are not rotations (determinant not 1)")
    T[:, :3, :3] = nearest_rotation(T[:, :3, :3])
    stamps_s, T = _increasing(stamps_s, T, source, notes)
    return Trajectory(stamps_s, T, source, tuple(notes))


def _from_kitti(table: FloatArray, path: Path, stamps_s: FloatArray | None) -> Trajectory:
    notes: list[str] = []
    if stamps_s is None:
        sequence = path.parent.parent / "sequences" / path.stem / _TIMES  # of poses/00.txt, as KITTI has them
        stamps_s = _stamps_beside(path.with_name(_TIMES), sequence)
    stamped = stamps_s is not None
    if stamps_s is None:
        notes.append("no times.txt beside the KITTI poses: rows are matched by number, at 10 Hz")
        stamps_s = np.arange(len(table)) / 10.0  # KITTI odometry's frame rate
    if len(stamps_s) != len(table):
        raise EvaluationError(f"{path}: {len(table)} poses but {len(stamps_s)} stamps")
    T = np.tile(np.eye(4), (len(table), 1, 1))
    T[:, :3, :] = table.reshape(-1, 3, 4)
    found = _from_matrices(np.asarray(stamps_s, dtype=np.float64), T, str(path), notes)
    return replace(found, numbered="" if stamped else ROWS)


def _stamps_beside(*places: Path) -> FloatArray | None:
    """Stamps [s] of the first of these files that is there."""
    times = next((file for file in places if file.is_file()), None)
    return None if times is None else seconds_of(_read_table(times).numbers([0])[:, 0])[0]


def _from_seven_scenes(files: list[Path], folder: Path) -> Trajectory:
    numbers = np.array([int("".join(c for c in file.name.split(".")[0] if c.isdigit()) or -1) for file in files])
    T = np.empty((len(files), 4, 4))
    for i, file in enumerate(files):
        table = _read_table(file).numbers()
        if table.shape != (4, 4):
            raise EvaluationError(f"{file}: a 7-Scenes pose is 4x4 numbers, got {table.shape[0]}x{table.shape[1]}")
        T[i] = table
    stamps_s = _stamps_beside(folder / _TIMES)
    if stamps_s is not None:
        if len(stamps_s) != len(files):
            raise EvaluationError(f"{folder}: {len(files)} poses but {len(stamps_s)} stamps in {_TIMES}")
        return _from_matrices(stamps_s, T, str(folder), [])
    note = f"7-Scenes has no stamps: frame number / {SEVEN_SCENES_HZ:g} s"
    return replace(_from_matrices(numbers / SEVEN_SCENES_HZ, T, str(folder), [note]), numbered=FRAMES)
