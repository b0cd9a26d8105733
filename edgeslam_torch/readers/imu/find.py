"""The IMU of a recording: given files, ``imu.csv`` in its folder, EuRoC's ``imu0``, TUM RGB-D's accelerometer."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.errors import EdgeSlamError, SourceError
from edgeslam_torch.files.imu_files import READINGS
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera_file import camera_keys
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.readers.imu.model import matrix, read_model
from edgeslam_torch.readers.imu.table import read_readings

NONE = "none"
"""Given in place of a file: no IMU is used."""
EUROC, KINECT = Path("imu0", "data.csv"), "accelerometer.txt"
_T_KINECT_CAM = np.diag([-1.0, -1.0, 1.0, 1.0])
"""The Kinect's accelerometer has x left, y up, z forward (https://cvg.cit.tum.de/data/datasets/rgbd-dataset)."""
_MISSING_S = 0.5
"""Time without readings at either end of a recording that is worth a remark."""
_LONGEST_S = 3600.0
"""Time by which the readings of a video of unknown length begin."""


Imu = tuple[ImuModel | None, ImuReadings | None, list[str]]
"""Model and readings, None without an IMU, and remarks for the user."""


@dataclass(frozen=True, slots=True)
class Given:
    """Files from the command line."""

    readings: Path | None = None
    model: Path | None = None
    camera: Path | None = None
    """Calibration, which may hold the IMU's numbers, too: ORB-SLAM3's, Kalibr's."""


def find_imu(
    folders: Sequence[Path], given: Given, span: Callable[[], tuple[float, float]], inside: ImuReadings | None = None
) -> Imu:
    """The IMU of a recording; none, with a warning, if the files found beside it are unusable: the images alone make a
    run.

    Args:
        folders: Where to look: the recording's, and that of its images.
        given: Files that the user named.
        span: Stamps of the first and the last frame [s]; the last may be infinite.
        inside: Readings in the recording itself, a bag.

    Raises:
        SourceError, CalibrationError: If a given file does not exist or is unusable.
    """
    path = given.readings
    if path is None and inside is None:
        candidates = [place / name for folder in folders for place, name in _places(folder)]
        path = next((candidate for candidate in candidates if candidate.is_file()), None)
    if path is None and inside is None:
        if given.model is not None:
            raise SourceError(f"{given.model}: --imu-model describes an IMU, and there are no readings of one")
        return None, None, []
    try:
        model, readings, remarks = _read(path, inside, [*([path.parent] if path is not None else []), *folders], given)
        return model, readings, [*remarks, *_coverage(model, readings, *span())]
    except EdgeSlamError as error:
        if given.readings is not None or given.model is not None:
            raise
        return None, None, [f"the IMU is not used: {error}"]


def _places(folder: Path) -> list[tuple[Path, str | Path]]:
    """Folders and files in them that may hold readings, for a recording's folder or EuRoC's ``cam0`` in it."""
    return [(folder, READINGS), (folder / "mav0", EUROC), (folder.parent, EUROC), (folder, KINECT)]


def _read(
    path: Path | None, inside: ImuReadings | None, folders: Sequence[Path], given: Given
) -> tuple[ImuModel, ImuReadings, list[str]]:
    if path is not None and path.name == KINECT and given.model is None:
        readings, remarks = read_readings(path)
        model = ImuModel(rate_hz=readings.rate_hz, T_imu_cam=_T_KINECT_CAM, time_offset_s=0.0, source=KINECT)
        return model, readings, remarks
    if path is not None:
        readings, remarks = read_readings(path)
    else:
        assert inside is not None
        readings, remarks = inside, []
    files = [given.model] if given.model is not None else _models(folders)
    files += [given.camera] if given.camera is not None and given.camera.is_file() else []
    is_euroc = path is not None and path.parent.name == EUROC.parent.name
    by_poses = _by_poses(path.parent, folders) if path is not None and is_euroc else {}
    model, assumed = read_model(list(dict.fromkeys(files)), readings.rate_hz, by_poses)
    return model, readings, [*remarks, *assumed]


def _models(folders: Sequence[Path]) -> list[Path]:
    """Files of these folders that may describe an IMU: ours, Kalibr's, OpenVINS's, and TUM-VI's in ``dso``."""
    places = [place for folder in folders for place in (folder, folder / "dso", folder.parent / "dso")]
    patterns = ("*imu*.y*ml", "sensor.yaml", "cam*.y*ml")
    return [file for place in places for pattern in patterns for file in sorted(place.glob(pattern))]


def _by_poses(folder: Path, folders: Sequence[Path]) -> dict[str, Any]:
    """Mount by both sensors' pose in the body, EuRoC's ``T_BS``; the data set's clocks are one."""
    camera = next((other for other in folders if other.name.startswith("cam")), folder.parent / "cam0")
    files = [sensor / "sensor.yaml" for sensor in (folder, camera)]
    records = [camera_keys(file) if file.is_file() else {} for file in files]
    if not all("T_BS" in record for record in records):
        return {}
    try:
        T_body_imu, T_body_cam = (matrix(record["T_BS"]) for record in records)
        return {"T_imu_cam": se3.inverse(T_body_imu) @ T_body_cam, "time_offset_s": 0.0}
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{files[0]}, {files[1]}: T_BS is not a 4 x 4 matrix") from error


def _coverage(model: ImuModel, readings: ImuReadings, first_s: float, last_s: float) -> list[str]:
    """Remark about frames without readings."""
    begin_s, end_s = readings.stamps_s[[0, -1]] - (model.time_offset_s or 0.0)
    if end_s < first_s or begin_s > min(last_s, first_s + _LONGEST_S):
        until = f" to {last_s:.2f}" if math.isfinite(last_s) else ""
        raise SourceError(
            f"its readings are stamped {begin_s:.2f} to {end_s:.2f} s, the frames {first_s:.2f}{until} s: those "
            "of another flight, or of a clock that counts other seconds"
        )
    missing_s = max(0.0, begin_s - first_s) + max(0.0, (last_s if math.isfinite(last_s) else end_s) - end_s)
    return [f"IMU readings are missing for {missing_s:.1f} s of the images"] if missing_s > _MISSING_S else []
