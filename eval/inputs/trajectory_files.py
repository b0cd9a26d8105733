"""Trajectory files: TUM, EuRoC, KITTI and 7-Scenes, read and written.

All give poses of the camera in the world; those of a body whose camera is not known stay the body's. Every reader
refuses what cannot be a trajectory with one line that names the file and the likely mistake.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.files.record_files import plain_yaml
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray

SEVEN_SCENES_HZ = 30.0
"""The 7-Scenes files carry no stamps; the sensor ran at 30 Hz."""

_TIMES = "times.txt"
"""Stamps beside poses whose format has none, as KITTI has them."""

_OF_THE_BODY = ("state_groundtruth_estimate0", "mocap0")
"""Folders of an EuRoC sequence whose poses are the body's; those of cam0 differ by the mount in its ``sensor.yaml``."""

_LARGE_TEXT = 1 << 20
_MAX_FILE_BYTES = 1 << 30
"""A gigabyte of poses is 80 hours at 100 Hz: larger files are something else (a bag, a video)."""


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
    rows: FloatArray | None = None
    """``(N, 7)`` position and quaternion as the file gives them, so that a wrong order can be recognised."""
    stamped: bool = True
    """False when the file has no stamps and they were made up from the rows' numbers."""

    def __len__(self) -> int:
        return len(self.stamps_s)

    @property
    def positions(self) -> FloatArray:
        """Camera centres ``(N, 3)``."""
        return self.T_w_c[:, :3, 3]

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_] | slice) -> "Trajectory":
        """The poses at ``index``."""
        rows = None if self.rows is None else self.rows[index]
        return replace(self, stamps_s=self.stamps_s[index], T_w_c=self.T_w_c[index], rows=rows)


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
    table, first_line = _read_table(path)
    columns = table.shape[1]
    if columns == 8:
        return _from_rows(table[:, 0], table[:, 1:8], path)
    if columns == 12:
        return _from_kitti(table, path, stamps_s)
    if columns in (11, 17) or (columns > 8 and path.suffix == ".csv"):  # EuRoC: ns, p, q (w first), v, biases
        return _of_camera(_from_rows(table[:, 0] * 1e-9, table[:, [1, 2, 3, 5, 6, 7, 4]], path), path)
    hint = " (positions without orientation?)" if columns == 4 else ""
    raise EvaluationError(
        f"{path}: {columns} number(s) a row from line {first_line} on{hint}; TUM has 8 (t x y z qx qy qz qw), "
        "KITTI 12, EuRoC 17"
    )


def write_tum(trajectory: Trajectory, path: Path | str) -> None:
    """Write ``t tx ty tz qx qy qz qw``, camera to world."""
    rows = [
        f"{stamp:.6f} " + " ".join(f"{x:.9f}" for x in se3.pose_to_tum(T))
        for stamp, T in zip(trajectory.stamps_s, trajectory.T_w_c, strict=True)
    ]
    Path(path).write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n", encoding="ascii")


def write_euroc(trajectory: Trajectory, path: Path | str) -> None:
    """Write EuRoC's ``ns, px, py, pz, qw, qx, qy, qz`` followed by zero velocity and biases."""
    header = "#timestamp [ns],px,py,pz,qw,qx,qy,qz,vx,vy,vz,bwx,bwy,bwz,bax,bay,baz"
    rows = []
    for stamp, T in zip(trajectory.stamps_s, trajectory.T_w_c, strict=True):
        x = se3.pose_to_tum(T)
        numbers = [f"{v:.9f}" for v in (*x[:3], x[6], *x[3:6])] + ["0"] * 9
        rows.append(f"{round(stamp * 1e9)}," + ",".join(numbers))
    Path(path).write_text(header + "\n" + "\n".join(rows) + "\n", encoding="ascii")


def write_kitti(trajectory: Trajectory, path: Path | str) -> None:
    """Write 12 numbers a row and the stamps to ``times.txt`` beside it."""
    path = Path(path)
    np.savetxt(path, trajectory.T_w_c[:, :3, :].reshape(-1, 12), fmt="%.9e")
    np.savetxt(path.with_name(_TIMES), trajectory.stamps_s, fmt="%.9f")


def write_seven_scenes(trajectory: Trajectory, folder: Path | str) -> None:
    """Write one ``frame-NNNNNN.pose.txt`` a pose.

    The number is the stamp in 30 Hz frames where the stamps are such (7-Scenes' own); else poses are numbered in
    order and their stamps written to ``times.txt`` beside them, as for KITTI.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    frames = trajectory.stamps_s * SEVEN_SCENES_HZ
    numbers = np.round(frames).astype(int)
    own = numbers[0] >= 0 and numbers[-1] < 10**6 and np.abs(frames - numbers).max() < 0.01
    if not own:
        numbers = np.arange(len(numbers))
        np.savetxt(folder / _TIMES, trajectory.stamps_s, fmt="%.9f")
    for number, T in zip(numbers, trajectory.T_w_c, strict=True):
        np.savetxt(folder / f"frame-{number:06d}.pose.txt", T, fmt="%.9e")


WRITERS: dict[str, Callable[[Trajectory, Path | str], None]] = {
    "tum": write_tum,
    "euroc": write_euroc,
    "kitti": write_kitti,
    "7scenes": write_seven_scenes,
}


def _read_folder(folder: Path) -> Trajectory:
    names = (
        "trajectory.txt",
        "groundtruth.txt",
        "mav0/state_groundtruth_estimate0/data.csv",
        "state_groundtruth_estimate0/data.csv",
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


def _read_table(path: Path) -> tuple[FloatArray, int]:
    """Numbers of a text table and the line of its first row."""
    text = _read_text(path)
    if len(text) > _LARGE_TEXT:
        table = _quickly(text)
        if table is not None:
            return table, 1
    rows: list[list[float]] = []
    lines = text.splitlines()
    first_line, first_words = 0, ""
    for number, line in enumerate(lines, start=1):
        fields = line.split("#", 1)[0].replace(",", " ").split()
        if not fields:
            continue
        try:
            rows.append([float(x) for x in fields])
        except ValueError as error:
            if not rows:  # a header without '#'
                first_words = first_words or line.strip()[:60]
                continue
            raise EvaluationError(f"{path}: line {number} is not numbers: {line.strip()[:60]!r}") from error
        first_line = first_line or number
        if len(rows[-1]) != len(rows[0]):
            if number == len(lines) and not text.endswith("\n"):
                rows.pop()  # the last line is incomplete
                break
            raise EvaluationError(
                f"{path}: line {number} has {len(rows[-1])} numbers, line {first_line} has {len(rows[0])}"
            )
    if not rows and first_words:
        raise EvaluationError(
            f"{path}: no line of numbers in it, the first is {first_words!r}; a TUM trajectory has "
            "'t x y z qx qy qz qw' on each line, between spaces or commas"
        )
    if not rows:
        raise EvaluationError(f"{path}: the file holds no poses (did the run stop before its first frame?)")
    return np.array(rows), first_line


def _read_text(path: Path) -> str:
    try:
        if path.stat().st_size > _MAX_FILE_BYTES:
            raise EvaluationError(f"{path}: {path.stat().st_size / 1e9:.1f} GB is too large for a trajectory file")
        return path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise EvaluationError(f"{path}: no such trajectory file") from error
    except UnicodeDecodeError as error:
        raise EvaluationError(f"{path}: not a text file, so not a trajectory") from error
    except OSError as error:
        raise EvaluationError(f"{path}: cannot be read ({error.strerror})") from error


def _quickly(text: str) -> FloatArray | None:
    """The table by NumPy's reader, ten times as fast; None on any irregularity."""
    commas = "," in text[: text.find("\n", len(text) // 2)].rsplit("\n", 1)[-1]
    try:
        return np.loadtxt(io.StringIO(text), dtype=np.float64, delimiter="," if commas else None, ndmin=2)
    except ValueError:
        return None


def _from_rows(stamps_s: FloatArray, rows: FloatArray, path: Path) -> Trajectory:
    """Trajectory from stamps and ``x y z qx qy qz qw``, cleaned and checked."""
    notes: list[str] = []
    finite = np.isfinite(stamps_s) & np.isfinite(rows).all(axis=1)
    if not finite.any():
        raise EvaluationError(f"{path}: every pose holds a NaN or infinity")
    if not finite.all():
        notes.append(f"{np.count_nonzero(~finite)} of {len(rows)} poses are not finite and were left out")
    stamps_s, rows = stamps_s[finite], rows[finite]
    norms = np.linalg.norm(rows[:, 3:], axis=1)
    odd = np.abs(norms - 1.0) > 0.05  # files with three decimals stay within 0.005
    if odd.mean() > 0.5:
        raise EvaluationError(
            f"{path}: the last four numbers of a row are no unit quaternion (norm {np.median(norms):.3g}); "
            "the order must be t x y z qx qy qz qw"
        )
    if odd.any():
        notes.append(f"{np.count_nonzero(odd)} poses without a unit quaternion were left out")
        stamps_s, rows = stamps_s[~odd], rows[~odd]
    stamps_s, rows, more = _increasing(stamps_s, rows)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3] = Rotation.from_quat(rows[:, 3:]).as_matrix()
    T[:, :3, 3] = rows[:, :3]
    return Trajectory(stamps_s, T, str(path), tuple(notes + more), rows)


def _of_camera(body: Trajectory, path: Path) -> Trajectory:
    """EuRoC's true poses, which are the body's, as those of ``cam0``: its images are what a run sees."""
    sensor = path.resolve().parent.parent / "cam0" / "sensor.yaml"
    if path.resolve().parent.name not in _OF_THE_BODY or not sensor.is_file():
        return body
    try:
        record = plain_yaml(sensor.read_text(encoding="utf-8"))
        if not isinstance(record, dict) or "T_BS" not in record:
            return body
        T_b_c = np.array(record["T_BS"]["data"], dtype=np.float64).reshape(4, 4)
    except (OSError, ValueError, TypeError, KeyError, RecursionError) as error:
        raise EvaluationError(f"{sensor}: T_BS, the camera's pose on the body, cannot be read ({error})") from error
    R = T_b_c[:3, :3]
    if not np.isfinite(T_b_c).all() or np.abs(R @ R.T - np.eye(3)).max() > 0.01 or np.linalg.det(R) < 0:
        raise EvaluationError(f"{sensor}: T_BS, the camera's pose on the body, is no rotation and translation")
    note = "the body's poses were turned into cam0's (T_BS of its sensor.yaml)"
    return replace(body, T_w_c=body.T_w_c @ T_b_c, notes=(*body.notes, note))


def _increasing(stamps_s: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray, list[str]]:
    """Rows in order of time, one a stamp."""
    notes: list[str] = []
    steps = np.diff(stamps_s)
    if len(steps) and np.all(steps < 0):
        notes.append("the rows run backwards in time: sorted")
    elif np.any(steps < 0):
        notes.append(f"{np.count_nonzero(steps < 0)} rows are out of order in time: sorted")
    order = np.argsort(stamps_s, kind="stable")
    stamps_s, rows = stamps_s[order], rows[order]
    first = np.concatenate([[True], np.diff(stamps_s) > 0])
    if not first.all():
        notes.append(f"{np.count_nonzero(~first)} row(s) repeat a stamp: the first of each was kept")
    return stamps_s[first], rows[first], notes


def _from_matrices(stamps_s: FloatArray, T: FloatArray, source: str, notes: list[str]) -> Trajectory:
    finite = np.isfinite(T).all(axis=(1, 2)) & np.isfinite(stamps_s)
    if not finite.any():
        raise EvaluationError(f"{source}: every pose holds a NaN or infinity")
    if not finite.all():
        notes.append(f"{np.count_nonzero(~finite)} of {len(T)} poses are not finite and were left out")
    stamps_s, T = stamps_s[finite], T[finite].copy()
    if np.median(np.abs(np.linalg.det(T[:, :3, :3]) - 1.0)) > 0.05:
        raise EvaluationError(f"{source}: the 3x3 parts are no rotations (determinant not 1)")
    T[:, :3, :3] = Rotation.from_matrix(T[:, :3, :3]).as_matrix()
    stamps_s, T, more = _increasing(stamps_s, T)
    return Trajectory(stamps_s, T, source, tuple(notes + more))


def _from_kitti(table: FloatArray, path: Path, stamps_s: FloatArray | None) -> Trajectory:
    notes: list[str] = []
    if stamps_s is None and path.with_name(_TIMES).is_file():
        stamps_s = _read_table(path.with_name(_TIMES))[0][:, 0]
    stamped = stamps_s is not None
    if stamps_s is None:
        notes.append("no times.txt beside the KITTI poses: rows are matched by number, at 10 Hz")
        stamps_s = np.arange(len(table)) / 10.0  # KITTI odometry's frame rate
    if len(stamps_s) != len(table):
        raise EvaluationError(f"{path}: {len(table)} poses but {len(stamps_s)} stamps")
    T = np.tile(np.eye(4), (len(table), 1, 1))
    T[:, :3, :] = table.reshape(-1, 3, 4)
    found = _from_matrices(np.asarray(stamps_s, dtype=np.float64), T, str(path), notes)
    return replace(found, stamped=stamped)


def _from_seven_scenes(files: list[Path], folder: Path) -> Trajectory:
    numbers = np.array([int("".join(c for c in file.name.split(".")[0] if c.isdigit()) or -1) for file in files])
    T = np.empty((len(files), 4, 4))
    for i, file in enumerate(files):
        table = _read_table(file)[0]
        if table.shape != (4, 4):
            raise EvaluationError(f"{file}: a 7-Scenes pose is 4x4 numbers, got {table.shape[0]}x{table.shape[1]}")
        T[i] = table
    if (folder / _TIMES).is_file():
        stamps_s = _read_table(folder / _TIMES)[0][:, 0]
        if len(stamps_s) != len(files):
            raise EvaluationError(f"{folder}: {len(files)} poses but {len(stamps_s)} stamps in {_TIMES}")
        return _from_matrices(stamps_s, T, str(folder), [])
    note = f"7-Scenes has no stamps: frame number / {SEVEN_SCENES_HZ:g} s"
    return replace(_from_matrices(numbers / SEVEN_SCENES_HZ, T, str(folder), [note]), stamped=False)
