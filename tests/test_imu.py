"""Records of an IMU, and their way to the SLAM system."""

import numpy as np
import pytest

from edgeslam_torch.imu import ImuModel, ImuReadings, check_readings
from edgeslam_torch.readers.pace import ReadingsCursor
from edgeslam_torch.types import TelemetrySample


def readings(*stamps_s):
    n = len(stamps_s)
    return ImuReadings(np.array(stamps_s, dtype=float), np.zeros((n, 3)), np.tile([0, 0, 9.81], (n, 1)))


@pytest.mark.parametrize(
    "fields",
    [
        (np.zeros(2), np.zeros((2, 3)), np.zeros((2, 3))),  # stamps do not increase
        (np.arange(2.0), np.zeros((3, 3)), np.zeros((2, 3))),
        (np.arange(2.0), np.zeros((2, 3)), np.full((2, 3), np.nan)),
        (np.arange(2.0), np.array([[0, 0, np.nan], [0, 0, 0]]), np.zeros((2, 3))),
        (np.array([0.0, np.nan]), np.zeros((2, 3)), np.zeros((2, 3))),
    ],
)
def test_inconsistent_readings_are_refused(fields):
    with pytest.raises(ValueError, match="IMU readings"):
        ImuReadings(*fields)


@pytest.mark.parametrize(
    "fields",
    [{"rate_hz": 0}, {"gyroscope_noise_density": np.nan}, {"T_imu_cam": np.ones((4, 4))}, {"time_offset_s": np.inf}],
)
def test_impossible_models_are_refused(fields):
    with pytest.raises(ValueError, match="IMU|T_imu_cam"):
        ImuModel(**fields)


def test_parts_join_in_time_order_without_doubled_or_reversed_stamps():
    joined = ImuReadings.joined([readings(0, 1, 2), readings(), readings(2, 3), readings(1, 4)])
    assert joined.stamps_s.tolist() == [0, 1, 2, 3, 4]
    assert len(ImuReadings.joined([])) == 0


class Source:
    telemetry = [TelemetrySample(0.1 * i) for i in range(100)]
    imu_readings = readings(*(0.005 * np.arange(2000)))

    def __init__(self, offset_s):
        self.imu = ImuModel(time_offset_s=offset_s)


@pytest.mark.parametrize("offset_s", [None, 0.03, -0.03])
def test_every_reading_is_given_once_up_to_the_frame_by_its_own_clock(offset_s):
    source, given, told = Source(offset_s), [], []
    cursor = ReadingsCursor(source)
    for stamp_s in (0.05, 0.05, 0.1, 1.0, 1.033, 9.0):
        new = cursor.until(stamp_s)
        check_readings(new)
        given += [r for r in new if isinstance(r, ImuReadings)]
        told += [r for r in new if isinstance(r, TelemetrySample)]
        newest_s = given[-1].stamps_s[-1] - (offset_s or 0.0)
        assert stamp_s - 0.0051 < newest_s <= stamp_s + 1e-9
    stamps_s = np.concatenate([part.stamps_s for part in given])
    assert stamps_s.tolist() == Source.imu_readings.stamps_s[: len(stamps_s)].tolist()
    assert told == Source.telemetry[:91]
