"""KITTI odometry: ``sequences/00/image_2/000000.png``, ``times.txt`` and ``calib.txt``; truth in ``poses/00.txt``.

https://www.cvlibs.net/datasets/kitti/eval_odometry.php. Uses the left colour camera (``image_2``) if present, else
the left grey one (``image_0``). True poses are those of the grey camera, 6 cm beside the colour camera.
"""

import math
from pathlib import Path

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.files.tables import read_text
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.readers.images import image_files, usual_size
from edgeslam_torch.readers.listing import ImageEntry, Problem, image_times, in_order, read_times
from edgeslam_torch.readers.sequence import Sequence

KIND = "kitti"

_CAMERAS = {"image_2": "P2", "image_0": "P0"}
"""Image folder: its projection matrix in ``calib.txt``."""


def recognises(folder: Path) -> bool:
    """Whether the folder has KITTI's clock and one of its left cameras."""
    return (folder / "times.txt").is_file() and any((folder / name).is_dir() for name in _CAMERAS)


def read(folder: Path) -> Sequence:
    """Images with the stamps of ``times.txt``, whose line is the number in an image's name."""
    name = next(name for name in _CAMERAS if (folder / name).is_dir())
    stamps, problems = image_times(read_times(folder / "times.txt"), str(folder / "times.txt"))
    entries: list[ImageEntry] = []
    for path in image_files(folder / name):
        number = int(path.stem) if path.stem.isdecimal() else -1
        if 0 <= number < len(stamps):
            entries.append(ImageEntry(len(entries), float(stamps[number]), path))
        else:
            problems.append(Problem(str(path), "its name is not a line of times.txt"))
    kept, more = in_order(entries, str(folder / name))
    truth = folder.resolve().parent.parent / "poses" / f"{folder.resolve().name}.txt"
    return Sequence(
        KIND,
        folder,
        tuple(kept),
        (*problems, *more),
        groundtruth=truth if truth.is_file() else None,
        groundtruth_stamps_s=tuple(stamps.tolist()),
        camera=_camera(folder / "calib.txt", _CAMERAS[name], kept),
    )


def _camera(path: Path, matrix: str, images: list[ImageEntry]) -> Camera | None:
    """Rectified pinhole camera from the line ``P2: fx 0 cx tx 0 fy cy ty 0 0 1 tz``; None without the file."""
    if not path.is_file() or not images:
        return None
    lines = dict(line.split(":", 1) for line in read_text(path, CalibrationError).splitlines() if ":" in line)
    try:
        p = [float(word) for word in lines[matrix].split()]
        fx, cx, fy, cy = p[0], p[2], p[5], p[6]
    except (KeyError, ValueError, IndexError) as error:
        raise CalibrationError(f"{path}: no line '{matrix}:' with the 12 numbers of a projection matrix") from error
    if not (0 < fx < math.inf and 0 < fy < math.inf and math.isfinite(cx) and math.isfinite(cy)):
        raise CalibrationError(f"{path}: {matrix} is not a camera's projection matrix")
    return Camera(*usual_size(images, str(path.parent)), fx, fy, cx, cy, source=f"KITTI's calibration {matrix}")
