"""Accelerometers beside a recording's images: ``accelerometer.txt`` of TUM RGB-D, ``imu.csv`` with ``imu.yaml``."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edgeslam_torch.errors import EdgeSlamError, SourceError
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.files.tables import read_table
from edgeslam_torch.files.time_units import UNKNOWN, seconds_of
from edgeslam_torch.geometry.level import SpecificForce
from edgeslam_torch.types import FloatArray

KINECT, IMU, MOUNT = "accelerometer.txt", "imu.csv", "imu.yaml"
_GAPS_S = (1e-4, 1.0)
"""Time between readings: 10 kHz to 1 Hz."""
_R_CAMERA_KINECT = np.diag([-1.0, -1.0, 1.0])
"""The Kinect's accelerometer has x left, y up, z forward (https://cvg.cit.tum.de/data/datasets/rgbd-dataset)."""
_KINECT_RAD = math.radians(4.0)
"""Standard deviation of its vertical: it is not calibrated."""
_IMU_RAD = math.radians(1.0)
"""Standard deviation of an IMU's vertical: biases of 0.1 m/s^2 and the calibration of the mount."""


def read_specific_force(folders: Sequence[Path]) -> tuple[SpecificForce | None, list[str]]:
    """Accelerometer readings of the first folder that has some, and warnings. An unreadable file causes a warning, not
    an error, because gravity is optional."""
    for folder in folders:
        try:
            if (folder / IMU).is_file() and (folder / MOUNT).is_file():
                return _imu(folder), []
            if (folder / KINECT).is_file():
                stamps_s, force = _readings(folder / KINECT, (0, 1, 2, 3))
                return SpecificForce(stamps_s, force @ _R_CAMERA_KINECT.T, _KINECT_RAD), []
        except EdgeSlamError as error:
            return None, [f"an accelerometer is not used: {error}"]
    return None, []


def _imu(folder: Path) -> SpecificForce:
    record = read_mapping(folder / MOUNT, "YAML", SourceError)
    try:
        T_imu_cam = np.array(record["T_imu_cam"], dtype=np.float64)
        offset_s = float(record.get("time_offset_s", 0.0))
    except (KeyError, TypeError, ValueError) as error:
        raise SourceError(f"{folder / MOUNT}: needs T_imu_cam, 4 x 4, and time_offset_s as a number") from error
    R = T_imu_cam[:3, :3] if T_imu_cam.shape == (4, 4) else np.zeros((3, 3))
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0 or not math.isfinite(offset_s):
        raise SourceError(f"{folder / MOUNT}: T_imu_cam is no rotation and translation, camera to IMU")
    stamps_s, force = _readings(folder / IMU, (0, 4, 5, 6))
    return SpecificForce(stamps_s - offset_s, force @ R, _IMU_RAD)


def _readings(path: Path, columns: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    values = read_table(path, SourceError).numbers(columns)
    values = values[np.isfinite(values).all(axis=1)]
    stamps_s, unit = seconds_of(values[:, 0], _GAPS_S)
    if len(values) < 2 or unit == UNKNOWN:
        raise SourceError(f"{path}: needs stamps and readings of an accelerometer in time order")
    order = np.argsort(stamps_s, kind="stable")
    return stamps_s[order], values[order, 1:]
