"""What a published recording lacks so that `run` and `eval` take it: lists with stamps, calibration, true poses."""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from edgeslam_torch.errors import SourceError
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory, write_tum
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.readers.layouts import read_sequence
from edgeslam_torch.types import FloatArray

ICL_HZ = 30.0
"""https://www.doc.ic.ac.uk/~ahanda/VaFRIC/iclnuim.html"""
_ICL_CAMERA = """# ICL-NUIM states fy = -480: its y axis points up. Here the axes are turned instead, poses included.
model: pinhole
width: 640
height: 480
fx: 481.2
fy: 480.0
cx: 319.5
cy: 239.5
distortion: [0.0, 0.0, 0.0, 0.0, 0.0]
depth_scale: 5000.0
"""
_UPSIDE_DOWN = np.diag([1.0, -1.0, 1.0, 1.0])

TARTANAIR_HZ = 20.0
"""Assumed: the data set has no stamps."""
_TARTANAIR_CAMERA = """# https://github.com/castacks/tartanair_tools/blob/master/data_type.md
model: pinhole
width: 640
height: 480
fx: 320.0
fy: 320.0
cx: 320.0
cy: 240.0
distortion: [0.0, 0.0, 0.0, 0.0, 0.0]
"""
_T_NED_CAMERA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Camera axes (right, down, forward) in the data set's (forward, right, down)."""
_T_UP_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
"""World with z down to world with z up."""


def prepare_published(folder: Path, truth: bytes | None) -> None:
    """TUM, 7-Scenes and EuRoC are read as they are."""


def prepare_icl(folder: Path, truth: bytes | None) -> None:
    """ICL-NUIM's TUM format has frame numbers for stamps, an axis upside down, and a truth named after its scene."""
    stated = sorted(folder.glob("*.gt.freiburg"))
    if len(stated) != 1:
        raise SourceError(f"{folder}: has {len(stated)} files *.gt.freiburg, not one")
    for name in ("rgb", "depth"):
        images = sorted((folder / name).glob("*.png"), key=lambda path: int(path.stem))
        _write_list(folder / f"{name}.txt", ((int(p.stem) / ICL_HZ, f"{name}/{p.name}") for p in images))
    rows = _numbers(stated[0].read_text(encoding="ascii"), 8, stated[0].name)
    poses = [_UPSIDE_DOWN @ _pose(row[1:]) @ _UPSIDE_DOWN for row in rows]
    _write_truth(folder, (row[0] / ICL_HZ for row in rows), poses)
    write_text(folder / "camera.yaml", _ICL_CAMERA)


def prepare_tartanair(folder: Path, truth: bytes | None) -> None:
    """TartanAir has images and a pose for each, in axes of its own, and no stamps."""
    images = sorted(folder.glob("*.png"))
    rows = _numbers((truth or b"").decode("ascii", errors="replace"), 7, "the true poses")
    if len(rows) != len(images):
        raise SourceError(f"{folder}: {len(images)} images and {len(rows)} true poses")
    stamps = [i / TARTANAIR_HZ for i in range(len(images))]
    _write_list(folder / "rgb.txt", zip(stamps, (p.name for p in images), strict=True))
    _write_truth(folder, stamps, (_T_UP_DOWN @ _pose(row) @ _T_NED_CAMERA for row in rows))
    write_text(folder / "camera.yaml", _TARTANAIR_CAMERA)


PREPARED: dict[str, Callable[[Path, bytes | None], None]] = {
    "tum": prepare_published,
    "7scenes": prepare_published,
    "euroc": prepare_published,
    "icl": prepare_icl,
    "tartanair": prepare_tartanair,
}
"""By a collection's ``layout``; called with the unpacked folder and the content of the true poses' file."""


def check_recording(folder: Path) -> None:
    """Refuse what no reader would take.

    Raises:
        SourceError: If the folder holds no recording.
    """
    sequence = read_sequence(folder)
    if sequence is None or not sequence.images:
        raise SourceError(f"{folder}: what was unpacked is not a recording; has the publisher changed the archive?")


def _numbers(text: str, count: int, name: str) -> list[list[float]]:
    lines = [line.split() for line in text.splitlines() if line.strip() and not line.startswith("#")]
    try:
        rows = [[float(word) for word in line] for line in lines]
    except ValueError as error:
        raise SourceError(f"{name}: not numbers ({error})") from error
    if not rows or any(len(row) != count for row in rows):
        raise SourceError(f"{name}: must have lines of {count} numbers")
    return rows


def _pose(row: list[float]) -> FloatArray:
    """``tx ty tz qx qy qz qw`` as a matrix."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(row[3:]).as_matrix(), row[:3]
    return T


def _write_list(path: Path, entries: Iterable[tuple[float, str]]) -> None:
    write_text(path, "# timestamp filename\n" + "".join(f"{stamp:.6f} {name}\n" for stamp, name in entries))


def _write_truth(folder: Path, stamps_s: Iterable[float], T_w_c: Iterable[FloatArray]) -> None:
    write_tum(Trajectory(np.array(list(stamps_s)), np.array(list(T_w_c))), folder / "groundtruth.txt")
