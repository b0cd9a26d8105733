"""An IMU's noise, mount and clock from the YAML files of calibration programs and other SLAM systems.

Our ``imu.yaml``, EuRoC's ``sensor.yaml``, Kalibr's ``imu.yaml`` and ``camchain-imucam.yaml``, and the settings of
ORB-SLAM3, VINS and OpenVINS hold the same numbers under other names.
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera_file import camera_keys
from edgeslam_torch.imu import ImuModel
from edgeslam_torch.types import FloatArray

_DENSITIES = {
    "gyroscope_noise_density": "gyroscopenoisedensity gyronoisedensity imunoisegyro sigmagc",
    "gyroscope_random_walk": "gyroscoperandomwalk gyrorandomwalk imugyrowalk sigmagwc",
    "accelerometer_noise_density": "accelerometernoisedensity accelnoisedensity imunoiseacc sigmaac",
    "accelerometer_random_walk": "accelerometerrandomwalk accelrandomwalk imuaccwalk sigmaawc",
}
_READING_SIGMAS = {"gyroscope_noise_density": "gyrn", "accelerometer_noise_density": "accn"}
"""VINS: standard deviations of single readings. Its bias walks are tuned to its own discretisation, so not read."""
_RATES = ("ratehz", "updaterate", "imufrequency")
_CAMERA_TO_IMU = ("timucam", "tbc", "imutbc1", "tbc1", "bodytcam0")
_IMU_TO_CAMERA = ("tcamimu",)
_OFFSETS = ("timeoffsets", "timeshiftcamimu", "td")
"""All of them: t_imu = t_cam + offset."""
_RATE_DIFFERENCE = 0.2


def read_model(
    paths: Sequence[Path], rate_hz: float, otherwise: Mapping[str, Any] | None = None
) -> tuple[ImuModel, list[str]]:
    """Model from all files together, of which the first one that states a number counts; and what was assumed.

    Args:
        paths: Files in the order of preference; files without any of the numbers are ignored.
        rate_hz: Of the readings, by their stamps.
        otherwise: Fields of `ImuModel` that no file states.

    Raises:
        CalibrationError: If a file is malformed, or holds impossible numbers.
    """
    found: dict[str, Any] = {}
    sources: list[str] = []
    for path in paths:
        with _named(path):
            new = {name: value for name, value in facts(camera_keys(path), rate_hz).items() if name not in found}
            ImuModel(**{name: value for name, value in new.items() if name != "stated_hz"})
        found |= new
        sources += [path.name] if new else []
    found = {**(otherwise or {}), **found}
    stated_hz = found.pop("stated_hz", rate_hz)
    model = ImuModel(**found, rate_hz=rate_hz, source=" and ".join(sources) or ImuModel().source)
    return model, _assumed(found, stated_hz, rate_hz)


def facts(record: dict[str, Any], rate_hz: float) -> dict[str, Any]:
    """What one file states, as fields of `ImuModel`; and ``stated_hz``.

    Args:
        record: Keys and values.
        rate_hz: Of the readings.

    Raises:
        ValueError: If a value is no number or no 4x4 matrix.
    """
    keys = {_plain(key): value for key, value in _one_imu_one_camera(record)}
    found: dict[str, Any] = {}
    for name, aliases in _DENSITIES.items():
        if (density := _first(keys, aliases.split())) is not None:
            found[name] = float(density)
        elif (sigma := keys.get(_READING_SIGMAS.get(name, ""))) is not None:
            found[name] = float(sigma) / math.sqrt(rate_hz)
    if found and (stated_hz := _first(keys, _RATES)) is not None:  # a file without any of them is a camera's
        found["stated_hz"] = float(stated_hz)
    if (offset := _first(keys, _OFFSETS)) is not None:
        found["time_offset_s"] = float(offset)
    if (T_imu_cam := _first(keys, _CAMERA_TO_IMU)) is not None:
        found["T_imu_cam"] = matrix(T_imu_cam)
    elif (T_cam_imu := _first(keys, _IMU_TO_CAMERA)) is not None:
        found["T_imu_cam"] = np.linalg.inv(matrix(T_cam_imu))
    if "extrinsicrotation" in keys and "extrinsictranslation" in keys:  # VINS-Mono
        found["T_imu_cam"] = np.eye(4)
        found["T_imu_cam"][:3, :3] = matrix(keys["extrinsicrotation"])
        found["T_imu_cam"][:3, 3] = matrix(keys["extrinsictranslation"]).ravel()
    return found


def _first(keys: dict[str, Any], aliases: Sequence[str]) -> Any:
    return next((keys[alias] for alias in aliases if keys.get(alias) is not None), None)


def matrix(value: Any) -> FloatArray:
    """A matrix as rows, or as OpenCV and EuRoC write it."""
    if isinstance(value, dict):
        return np.array(value["data"], dtype=np.float64).reshape(int(value["rows"]), int(value["cols"]))
    return np.array(value, dtype=np.float64)


def _one_imu_one_camera(record: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Keys and values of the file, its first IMU and its first camera."""
    for key, value in record.items():
        if re.fullmatch(r"(imu|cam|camera|base_imu)?0?", str(key)) and isinstance(value, dict):
            yield from value.items()
        else:
            yield str(key), value


def _plain(key: str) -> str:
    return re.sub(r"[^a-z0-9]", "", key.lower())


def _assumed(found: dict[str, Any], stated_hz: float, rate_hz: float) -> list[str]:
    """What the files leave open, in one line each."""
    remarks = []
    missing = [name for name in _DENSITIES if name not in found]
    if missing:
        words = (
            "no noise of the IMU is stated" if len(missing) == len(_DENSITIES) else f"{', '.join(missing)}: not stated"
        )
        remarks.append(f"{words} is not stated: that of a cheap one (MPU-6050) is assumed; --imu-model FILE states it")
    unknown = [word for name, word in (("T_imu_cam", "mount"), ("time_offset_s", "clock")) if name not in found]
    if unknown:
        remarks.append(f"the IMU's {' and '.join(unknown)} relative to the camera is not stated, so it is estimated")
    if abs(stated_hz / rate_hz - 1.0) > _RATE_DIFFERENCE:
        remarks.append(f"the IMU is said to have {stated_hz:g} readings a second, and has {rate_hz:.4g}")
    return remarks


@contextmanager
def _named(path: Path) -> Iterator[None]:
    try:
        yield
    except (KeyError, TypeError, ValueError, OverflowError, np.linalg.LinAlgError) as error:
        raise CalibrationError(f"{path}: no IMU's numbers ({error})") from error
