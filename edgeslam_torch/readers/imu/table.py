"""Readings of an IMU in a table with a header, or in EuRoC's order of columns; suspicious ones are reported."""

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.tables import Table, read_table
from edgeslam_torch.files.time_units import UNKNOWN, seconds_of
from edgeslam_torch.imu import ImuReadings
from edgeslam_torch.types import FloatArray

_GAPS_S = (1e-4, 1.0)
"""Time between readings: 10 kHz to 1 Hz."""
_G_M_S2 = 9.80665
_UNITS_M_S2 = {"m/s^2": 1.0, "g": _G_M_S2, "mg": 1e-3 * _G_M_S2}
_NEAR_G = (0.75, 1.35)
"""Median specific force of anything that flies or is carried, relative to gravity."""
_FASTEST_RAD_S = 70.0
"""4000 deg/s: the largest range of gyroscopes that are sold for drones."""
_GAP, _GAP_S = 5.0, 0.05
"""Multiple of the median interval between readings, and time, beyond which there is a gap."""
_EUROC = ((1, 2, 3), (4, 5, 6))
_GYROSCOPE = re.compile(r"(w|gyr|omega|ang|rot|g(?=[xyz]$)).*[xyz]")
_ACCELEROMETER = re.compile(r"(a|lin|force|f(?=[xyz]$)).*[xyz]")
_STAMP = re.compile(r"(time|stamp|t$|sec|ns|ts).*")
"""Letters of a column's name without its unit."""


def read_readings(path: Path) -> tuple[ImuReadings, list[str]]:
    """Readings of a table, and remarks.

    Raises:
        SourceError: If a column is missing or no number, or the numbers are no readings of an IMU.
    """
    table = read_table(path, SourceError)
    stamp, gyroscope, accelerometer, names = _columns(table)
    values = table.numbers([stamp, *gyroscope, *accelerometer])
    n = len(gyroscope)
    rate = values[:, 1:4]
    if any("deg" in name for name in names):
        rate = np.radians(rate)
    stamps_s, unit = seconds_of(values[:, 0], _GAPS_S)
    if unit == UNKNOWN:
        raise SourceError(f"{path}: its stamps are in no unit in which readings come 1 to 10000 times a second")
    try:
        readings, remarks = tidied(stamps_s, rate, values[:, 1 + n :], bool(n))
    except SourceError as error:
        raise SourceError(f"{path}: {error}") from error
    return readings, [f"{path}: {remark}" for remark in remarks]


def _columns(table: Table) -> tuple[int, Sequence[int], Sequence[int], Sequence[str]]:
    """Stamp, gyroscope (or none) and accelerometer, and the names of the latter two's columns."""
    width = len(table.rows[0].cells) if table.rows else 0
    names = [name.lower().removeprefix("field.") for name in table.header]
    plain = [re.sub(r"[\[(].*|[^a-z]", "", name) for name in names]
    axes = sorted(range(len(plain)), key=lambda i: plain[i][-1:])
    gyroscope = [i for i in axes if _GYROSCOPE.fullmatch(plain[i])]
    accelerometer = [i for i in axes if i not in gyroscope and _ACCELEROMETER.fullmatch(plain[i])]
    if [plain[i][-1] for i in accelerometer] == ["x", "y", "z"] and len({plain[i][-1] for i in gyroscope}) in (0, 3):
        stamp = next((i for i, name in enumerate(plain) if _STAMP.fullmatch(name)), 0)
        return stamp, gyroscope, accelerometer, [names[i] for i in (*gyroscope, *accelerometer)]
    if width == 7:
        return 0, *_EUROC, ()
    if width == 4:
        return 0, (), (1, 2, 3), ()
    raise SourceError(
        f"{table.path}: no IMU readings: needs a header with a stamp, gyro_x y z and acc_x y z, or EuRoC's 7 columns"
    )


def tidied(
    stamps_s: FloatArray, rate: FloatArray, force: FloatArray, has_gyroscope: bool
) -> tuple[ImuReadings, list[str]]:
    """Readings in m/s^2 with increasing stamps, and remarks on suspicious ones.

    Args:
        stamps_s: ``(N,)`` as recorded [s].
        rate: ``(N, 3)`` [rad/s].
        force: ``(N, 3)``; a unit of g is recognised by its size.
        has_gyroscope: Whether ``rate`` is measured.

    Raises:
        SourceError: If fewer than two readings remain, or these are none of an IMU.
    """
    remarks = []
    good = np.isfinite(stamps_s) & np.isfinite(force).all(axis=1)
    good &= np.isfinite(rate).all(axis=1) if has_gyroscope else True
    late = np.concatenate([[-np.inf], np.maximum.accumulate(np.where(good, stamps_s, -np.inf))[:-1]])
    in_order = good & (stamps_s > late)
    if (bad := int((~good).sum())) and good.any():
        remarks.append(f"{bad} readings without numbers are left out")
    if (back := int((good & ~in_order).sum())) and good.any():
        remarks.append(f"{back} readings with doubled or reversed stamps are left out")
    if in_order.sum() < 2:
        raise SourceError("fewer than two IMU readings in time order")
    stamps_s, rate, force = stamps_s[in_order], rate[in_order], force[in_order]
    rate = rate if has_gyroscope else np.full_like(force, np.nan)
    force, said = _in_m_s2(force)
    if has_gyroscope and float(np.abs(rate).max()) > _FASTEST_RAD_S:
        fastest = float(np.abs(rate).max())
        raise SourceError(f"angular rates of up to {fastest:.0f} rad/s: degrees? Then name the columns [deg/s]")
    readings = ImuReadings(stamps_s, rate, force)
    return readings, [*remarks, *said, *_gaps(stamps_s), *_clipped(readings)]


def _in_m_s2(force: FloatArray) -> tuple[FloatArray, list[str]]:
    with np.errstate(over="ignore"):
        size = float(np.median(np.linalg.norm(force, axis=1)))
    for unit, factor in _UNITS_M_S2.items():
        if _NEAR_G[0] < size * factor / _G_M_S2 < _NEAR_G[1]:
            said = [] if factor == 1.0 else [f"accelerations of about {size:.3g} are taken as {unit}"]
            return factor * force, said
    raise SourceError(
        f"accelerations of about {size:.3g}: an accelerometer's hold gravity, 9.81 m/s^2 or 1 g; was it removed?"
    )


def _gaps(stamps_s: FloatArray) -> list[str]:
    steps = np.diff(stamps_s)
    gaps = steps[steps > max(_GAP * float(np.median(steps)), _GAP_S)]
    return [f"{len(gaps)} gaps in the readings, up to {gaps.max():.3g} s"] if len(gaps) else []


def _clipped(readings: ImuReadings) -> list[str]:
    names = [f"{name}'s {axis}" for name in ("gyroscope", "accelerometer") for axis in "xyz"]
    values, ends = (
        np.abs(np.concatenate([readings.angular_rate_rad_s, readings.acceleration_m_s2], axis=1)),
        readings.range_ends,
    )
    return [
        f"the {name} is clipped at {end:.4g} in {100.0 * np.mean(column == end):.2g} % of the readings"
        for name, column, end in zip(names, values.T, ends.tolist(), strict=True)
        if np.isfinite(end)
    ]
