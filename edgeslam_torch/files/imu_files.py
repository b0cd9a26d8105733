"""Write an IMU's readings and model: ``imu.csv`` in EuRoC's columns and ``imu.yaml``."""

from pathlib import Path

import numpy as np
import yaml

from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.imu import MODEL_NUMBERS, ImuModel, ImuReadings

READINGS, MODEL = "imu.csv", "imu.yaml"
_AXES = "xyz"
_HEADER = ",".join(
    ["#timestamp [ns]", *(f"w_RS_S_{a} [rad s^-1]" for a in _AXES), *(f"a_RS_S_{a} [m s^-2]" for a in _AXES)]
)


def write_imu(folder: Path, readings: ImuReadings, model: ImuModel) -> None:
    """Write both files; the reader gives the same readings, with stamps to a nanosecond, and the same model."""
    values = np.column_stack([readings.angular_rate_rad_s, readings.acceleration_m_s2])
    stamps_ns = np.rint(readings.stamps_s * 1e9).astype(np.int64)
    rows = [
        f"{stamp},{','.join(map(repr, row))}" for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True)
    ]
    write_text(Path(folder) / READINGS, "\n".join([_HEADER, *rows]) + "\n")
    record: dict[str, object] = {name: float(getattr(model, name)) for name in MODEL_NUMBERS}
    if model.time_offset_s is not None:
        record["time_offset_s"] = float(model.time_offset_s)
    if model.T_imu_cam is not None:
        record["T_imu_cam"] = model.T_imu_cam.tolist()
    write_text(Path(folder) / MODEL, f"# {model.source}\n" + yaml.safe_dump(record, sort_keys=False))
