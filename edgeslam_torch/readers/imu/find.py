"""IMUs beside a recording's images: ``imu.csv`` with ``imu.yaml``, ``accelerometer.txt`` of TUM RGB-D."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edgeslam_torch.errors import EdgeSlamError, SourceError
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.files.tables import read_table
from edgeslam_torch.files.time_units import UNKNOWN, seconds_of
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.types import FloatArray

KINECT, READINGS, MODEL = "accelerometer.txt", "imu.csv", "imu.yaml"
_GAPS_S = (1e-4, 1.0)
"""Time between readings: 10 kHz to 1 Hz."""
_T_KINECT_CAM = np.diag([-1.0, -1.0, 1.0, 1.0])
"""The Kinect's accelerometer has x left, y up, z forward (https://cvg.cit.tum.de/data/datasets/rgbd-dataset)."""

Found = tuple[ImuModel | None, ImuReadings | None, list[str]]


def find_imu(folders: Sequence[Path]) -> Found:
    """Model and readings of the IMU in the first folder that has one, and warnings. An unreadable file causes a
    warning, not an error, because the images alone make a run."""
    for folder in folders:
        try:
            if (folder / READINGS).is_file():
                return _imu(folder)
            if (folder / KINECT).is_file():
                stamps_s, values = _table(folder / KINECT, (0, 1, 2, 3))
                felt = ImuReadings(stamps_s, np.full_like(values, np.nan), values)
                return ImuModel(T_imu_cam=_T_KINECT_CAM, time_offset_s=0.0, source=KINECT), felt, []
        except EdgeSlamError as error:
            return None, None, [f"an IMU is not used: {error}"]
    return None, None, []


def _imu(folder: Path) -> Found:
    stamps_s, values = _table(folder / READINGS, range(7))
    readings = ImuReadings(stamps_s, values[:, :3], values[:, 3:])
    if not (folder / MODEL).is_file():
        model = ImuModel()
        return model, readings, [f"{folder / READINGS}: no {MODEL} beside it; {model.source}, mount and clock unknown"]
    record = read_mapping(folder / MODEL, "YAML", SourceError)
    names = ("gyroscope_noise_density", "gyroscope_random_walk", "accelerometer_noise_density")
    names += ("accelerometer_random_walk", "rate_hz", "T_imu_cam", "time_offset_s")
    try:
        given = {name: record[name] for name in names if name in record}
        return ImuModel(**given, source=MODEL), readings, []
    except (TypeError, ValueError) as error:
        raise SourceError(f"{folder / MODEL}: {error}") from error


def _table(path: Path, columns: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Stamps [s] and finite values in time order."""
    values = read_table(path, SourceError).numbers(columns)
    values = values[np.isfinite(values).all(axis=1)]
    stamps_s, unit = seconds_of(values[:, 0], _GAPS_S)
    if len(values) < 2 or unit == UNKNOWN or not math.isfinite(stamps_s[0]):
        raise SourceError(f"{path}: needs stamps and readings of an IMU in time order")
    stamps_s, first = np.unique(stamps_s, return_index=True)
    return stamps_s, values[first, 1:]
