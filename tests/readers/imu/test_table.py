import re

import numpy as np
import pytest

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.imu.table import read_readings

N = 1000
STAMPS_S = 100.0 + 0.005 * np.arange(N)
RATE = 0.5 * np.sin(np.arange(N)[:, None] / [30.0, 40.0, 50.0])
FORCE = np.array([0.0, 0.0, 9.81]) + 2.0 * np.cos(np.arange(N)[:, None] / [35.0, 45.0, 55.0])


def written(path, header, *columns):
    rows = "\n".join(",".join(f"{x:.12g}" for x in row) for row in np.column_stack(columns))
    path.write_text(f"{header}\n{rows}\n")
    return path


@pytest.mark.parametrize(
    ("header", "columns"),
    [
        ("t,gx,gy,gz,ax,ay,az", (STAMPS_S, RATE, FORCE)),
        ("timestamp,acc_x,acc_y,acc_z,gyro_x,gyro_y,gyro_z,temperature", (STAMPS_S, FORCE, RATE, STAMPS_S)),
        ("timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z", (STAMPS_S * 1e9, RATE, FORCE)),
        ("time [ms],gyro_z,gyro_y,gyro_x,acc_z,acc_y,acc_x", (STAMPS_S * 1e3, RATE[:, ::-1], FORCE[:, ::-1])),
        (
            "#t,w_x [deg/s],w_y [deg/s],w_z [deg/s],a_x [g],a_y [g],a_z [g]",
            (STAMPS_S, RATE * 180 / np.pi, FORCE / 9.80665),
        ),
        (
            "%time,field.header.seq,field.angular_velocity.x,field.angular_velocity.y,field.angular_velocity.z,"
            "field.linear_acceleration.x,field.linear_acceleration.y,field.linear_acceleration.z",
            (STAMPS_S * 1e9, np.arange(N), RATE, FORCE),
        ),
        ("", (STAMPS_S, RATE, FORCE)),
    ],
)
def test_columns_and_units_are_found_by_their_names(tmp_path, header, columns):
    readings, said = read_readings(written(tmp_path / "imu.csv", header, *columns))
    assert readings.stamps_s == pytest.approx(STAMPS_S, abs=1e-6)
    assert readings.angular_rate_rad_s == pytest.approx(RATE, abs=1e-9)
    assert readings.acceleration_m_s2 == pytest.approx(FORCE, abs=1e-9)
    assert [line for line in said if "[g]" not in header] == []


CLIPPED = np.clip(FORCE, -10.8, 10.8)
DOUBLED = np.concatenate([STAMPS_S[:500], STAMPS_S[490:-10]])
GAP = STAMPS_S + np.where(np.arange(N) > 700, 0.4, 0.0)
MISSING = np.where(np.arange(N)[:, None] == 7, np.nan, FORCE)


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ((STAMPS_S, RATE, CLIPPED), "accelerometer's z is clipped at 10.8"),
        ((DOUBLED, RATE, FORCE), "10 readings with doubled or reversed"),
        ((GAP, RATE, FORCE), "1 gaps .* 0.405 s"),
        ((STAMPS_S, RATE, FORCE / 9.80665), "taken as g"),
        ((STAMPS_S, RATE, MISSING), "1 readings without numbers"),
    ],
)
def test_what_is_doubtful_is_said_in_one_line(tmp_path, columns, words):
    _, (said,) = read_readings(written(tmp_path / "imu.csv", "", *columns))
    assert re.search(words, said)


@pytest.mark.parametrize(
    ("columns", "words"),
    [((STAMPS_S, RATE * 300, FORCE), "degrees"), ((STAMPS_S, RATE, FORCE - [0, 0, 9.81]), "gravity"),
     ((STAMPS_S * 0 + 5.0, RATE, FORCE), "fewer than two"), ((STAMPS_S, RATE[:, :1]), "gyro"),
     ((STAMPS_S, RATE, FORCE, FORCE), "header"), ((STAMPS_S * 1e-9, RATE, FORCE), "unit")],
)  # fmt: skip
def test_what_is_no_imu_is_refused(tmp_path, columns, words):
    with pytest.raises(SourceError, match=words):
        read_readings(written(tmp_path / "imu.csv", "", *columns))


@pytest.mark.parametrize("text", ["", "1 2\n", "1 a b c d e f\n", "nan nan nan nan\n"])
def test_text_that_is_no_table_of_readings_is_refused(tmp_path, text):
    (tmp_path / "imu.csv").write_text(text)
    with pytest.raises(SourceError, match=r"imu\.csv"):
        read_readings(tmp_path / "imu.csv")
