"""`telemetry.csv`: a flight's state messages, in the SDK's own names and units, on the clock of the frames.

The reader also accepts other logs: other column names, milliseconds, units and axes inferred from the data.
"""

import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

import numpy as np

from edgeslam_torch.drone.sdk_state import FIELDS, sample_from_sdk
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.files import tables
from edgeslam_torch.files.appender import Appender
from edgeslam_torch.files.time_units import NAMES, SECONDS_PER_UNIT, UNKNOWN, seconds_of
from edgeslam_torch.files.units import known_units
from edgeslam_torch.readers.listing import longest_increasing
from edgeslam_torch.readers.logs.columns import QUANTITIES, column_of, unit_factor
from edgeslam_torch.readers.logs.foreign import foreign_log
from edgeslam_torch.readers.velocity_frame import body_frame_evidence
from edgeslam_torch.types import FloatArray, TelemetrySample

logger = logging.getLogger(__name__)

HEADER = ("stamp_s", *FIELDS)
_CLOCKS = ("timestamp", "time_stamp", "stamp", "t", "ts", "datetime", "date_time", "time")
_STAMPS = {
    **{f"{clock}_{unit}": factor for unit, factor in SECONDS_PER_UNIT.items() for clock in _CLOCKS},
    "ms": 1e-3,
    **dict.fromkeys(_CLOCKS, 0.0),
}
"""Column names of the clock, most reliable first; factor 0: unit inferred from the spacing. The SDK's ``time`` counts
whole seconds of motor time and is the last resort."""
_ATTITUDE = ("pitch", "roll", "yaw")
_VELOCITY = ("vgx", "vgy", "vgz")
_MAX_COLUMNS = 256
_MAX_BYTES = 512 * 1024 * 1024
_GAPS_S = (1e-3, 5.0)
"""Time between messages; a Tello sends ten a second."""
_WRAP = 2.0**32
"""A clock of 32 bits begins anew here: milliseconds after 50 days, microseconds after 72 minutes."""
_DAY_S = 86400.0


class TelemetryError(EdgeSlamError):
    """A telemetry file cannot be read."""


@dataclass(frozen=True, slots=True)
class TelemetryUnits:
    """How to read the velocity columns."""

    velocity_m_s: float = 0.1
    """Metres per second of one unit."""
    z_down: bool = True
    """Axes x forward, y right, z down with yaw clockwise; otherwise x forward, y left, z up."""
    evidence: str = "SDK default (dm/s, z down)"
    """Evidence, in words."""
    body_frame: bool = False
    """Whether horizontal velocities are in body axes; otherwise in the power-on world."""
    frame_evidence: str = ""


@dataclass(frozen=True, slots=True)
class TelemetryTable:
    """Numeric contents of a telemetry file."""

    stamps_s: FloatArray
    """``(M,)`` increasing."""
    values: dict[str, FloatArray]
    """SDK name to ``(M,)``, NaN where missing."""
    skipped: int
    """Skipped rows: malformed, or not newer than the previous one."""
    stated: frozenset[str] = frozenset()
    """Columns whose unit the file states."""
    remarks: tuple[str, ...] = ()
    """Remarks about unusable content, one sentence each."""

    def samples(self, units: TelemetryUnits | None = None) -> list[TelemetrySample]:
        """SI units and our axes."""
        units = units or TelemetryUnits()
        values = _turned_to_world(self.values) if units.body_frame else self.values
        names = list(values)
        columns = [values[name].tolist() for name in names]
        rows = zip(*columns, strict=True) if columns else ([()] * len(self.stamps_s))
        return [
            sample_from_sdk(stamp, dict(zip(names, row, strict=True)), units.velocity_m_s, units.z_down)
            for stamp, row in zip(self.stamps_s.tolist(), rows, strict=True)
        ]

    def warnings(self, name: str) -> list[str]:
        """Warnings about the file ``name``."""
        if len(self.stamps_s) == 0:
            return [f"{name}: holds no state message, so the run goes without telemetry"]
        said = [f"{name}: {remark}" for remark in self.remarks]
        if self.skipped:
            rows = len(self.stamps_s) + self.skipped
            said.append(f"{name}: {self.skipped} of {rows} rows left out, malformed or not newer than the row before")
        for what, names in (("velocity", _VELOCITY), ("attitude", _ATTITUDE)):
            columns = [self.values.get(n) for n in names]
            known = [c is not None and bool(np.isfinite(c).any()) for c in columns]
            if not all(known):
                said.append(f"{name}: holds no {what} ({', '.join(names)}), which the scale from telemetry needs")
        return said


def read_telemetry(path: Path) -> tuple[list[TelemetrySample], list[str]]:
    """Telemetry of a flight in SI units, in time order, and warnings about the file.

    Args:
        path: Our ``telemetry.csv`` or another log with a header line; `detect_units` tells how to read its velocities.

    Raises:
        TelemetryError: If the file is not there, is not text, or has no clock or no known column.
    """
    table = read_table(path)
    units = detect_units(table)
    logger.info("%s: velocities: %s; %s", path, units.evidence, units.frame_evidence or "frame: SDK default (world)")
    return table.samples(units), [*table.warnings(path.name), *_assumed_units(table, units, path.name)]


def read_table(path: Path) -> TelemetryTable:
    """The known columns, row by row; malformed rows are counted and skipped.

    Raises:
        TelemetryError: As `read_telemetry`.
    """
    foreign = foreign_log(path)
    if foreign is not None:
        raise TelemetryError(f"{path}: {foreign}")
    text = tables.read_table(path, TelemetryError, max_bytes=_MAX_BYTES)
    if not (text.header or text.rows):
        raise TelemetryError(f"{path}: empty; it needs a header line such as {','.join(HEADER[:4])},...")
    if not text.header:
        raise TelemetryError(f"{path}: no header line that names its columns, such as {','.join(HEADER[:4])},...")
    names = [_plain(name) for name in text.header]
    clock = next((name for name in _STAMPS if name in names), None)
    columns: dict[str, _Column] = {}
    for i, name in enumerate(names[:_MAX_COLUMNS]):
        known = None if name == clock else column_of(text.header[i])
        if known is not None:
            if math.isnan(known[1]):
                units = known_units(QUANTITIES[known[0]][0])
                raise TelemetryError(f"{path}: the unit of column {text.header[i]!r} is not known: {units}")
            columns.setdefault(known[0], _Column(i, *known))
    if clock is None or not columns:
        what, known_names = ("clock", _CLOCKS) if clock is None else ("known column", FIELDS)
        missing = f"no {what} ({', '.join(known_names)}) in its header line"
        raise TelemetryError(f"{path}: {missing}; give a telemetry.csv")
    at = names.index(clock)
    rows, skipped = _rows(text.rows, len(names), at, list(columns.values()))
    if text.rows and not rows:
        seen = text.rows[0].cells[at : at + 1]
        raise TelemetryError(
            f"{path}: none of its {len(text.rows)} rows has a time in column {text.header[at]!r} ({', '.join(seen)!r}) "
            f"and {len(names)} columns; it must be seconds, milliseconds, or date and time"
        )
    table = np.array(rows, dtype=np.float64).reshape(len(rows), 1 + len(columns))
    stamps, remarks = _seconds(table[:, 0], _STAMPS[clock], text.header[at])
    values: dict[str, FloatArray] = {name: table[:, 1 + i] for i, name in enumerate(columns)}
    for name, column in columns.items():
        cell = next((row.cells[column.index] for row in text.rows if row.cells[column.index : column.index + 1]), "")
        if rows and cell and np.isnan(values[name]).all():
            remarks.append(f"column {text.header[column.index]!r} holds no number ({cell[:20]!r})")
    stated = frozenset(name for name, column in columns.items() if column.stated)
    return TelemetryTable(stamps, values, skipped, stated, tuple(remarks))


@dataclass(frozen=True, slots=True)
class _Column:
    """Where a field is, and in which unit."""

    index: int
    name: str
    factor: float
    """SDK units per unit of the file."""
    stated: bool


def _seconds(stamps: FloatArray, factor: float, name: str) -> tuple[FloatArray, list[str]]:
    """Stamps in seconds, by the unit that is stated or, where none is or it is implausible, by their spacing."""
    unknown = f"the times in column {name!r} are plausible in no unit from nanoseconds to seconds"
    if not factor:
        seconds, unit = seconds_of(stamps, _GAPS_S)
        return seconds, [unknown] if unit == UNKNOWN else []
    seconds, unit = seconds_of(stamps * factor)
    if unit in ("s", UNKNOWN):
        return stamps * factor, [unknown] if unit == UNKNOWN else []
    unit = seconds_of(stamps)[1]
    return seconds_of(stamps)[0], [f"the times in column {name!r} are taken for {NAMES.get(unit, 'seconds')}"]


def _plain(name: str) -> str:
    """A clock's name without quotes, brackets, case and slashes: ``"Time (millisecond)"`` to ``time_ms``."""
    plain = "_".join(re.sub(r"[\"'()\[\]]", " ", name).replace("/", "_").lower().split())
    return re.sub(r"_(m|u|n)?(?:illi|icro|ano)?s(?:ec|econds?)?$", lambda found: f"_{found[1] or ''}s", plain)


def _rows(
    lines: Sequence[tables.Row], width: int, clock: int, columns: Sequence[_Column]
) -> tuple[list[list[float]], int]:
    """Stamps and values in time order, and the number of skipped rows: a wild stamp costs one."""
    stamps: list[float] = []
    timed: list[list[str]] = []
    last, turns = -math.inf, 0.0
    for line in lines:
        cells = line.cells[:-1] if len(line.cells) == width + 1 and not line.cells[-1] else line.cells
        stamp, period = _moment(cells[clock]) if len(cells) == width else (math.nan, _WRAP)
        if stamp + turns < last - 0.5 * period and last - turns <= period:  # the clock began anew
            turns += period
        if abs(stamp + turns) <= 1e19:
            last = stamp + turns
            stamps.append(last)
            timed.append(cells)
    keep = longest_increasing(np.array(stamps)).tolist()
    rows = [[stamps[i], *(_value(timed[i][c.index], c) for c in columns)] for i in keep]
    return rows, len(lines) - len(rows)


def _value(text: str, column: _Column) -> float:
    """A cell in the SDK's unit, with a unit of its own or not; NaN for anything else."""
    number = tables.number(text)
    if number is not None and math.isfinite(number):
        return number * column.factor
    found = re.fullmatch(r"([+-]?[\d.,]+)\s*([^\d\s].*)", text)
    amount = None if found is None else tables.number(found[1])
    if found is None or amount is None:
        return math.nan
    return amount * unit_factor(column.name, found[2])


def _moment(text: str) -> tuple[float, float]:
    """A number, or seconds of a date and time (Unix, UTC unless stated) or of a time of day; and when it begins anew.

    Example:
        >>> _moment("12:00:01.5")[0], _moment("01.05.2024 12:00:00")[0]
        (43201.5, 1714564800.0)
    """
    number = tables.number(text)
    if number is not None:
        return number, _WRAP
    day = re.fullmatch(r"(\d{1,2}):(\d{2}):(\d{2}(?:[.,]\d+)?)", text)
    if day is not None:
        return 3600.0 * int(day[1]) + 60.0 * int(day[2]) + float(day[3].replace(",", ".")), _DAY_S
    text = re.sub(r"^(\d{4})[/.](\d{1,2})[/.](\d{1,2}),?", r"\1-\2-\3", text)
    text = re.sub(r"^(\d{1,2})\.(\d{1,2})\.(\d{4}),?", lambda d: f"{d[3]}-{int(d[2]):02}-{int(d[1]):02}", text)
    try:
        moment = datetime.fromisoformat(text.replace(", ", " ")) if len(text) >= 16 else None
    except ValueError:
        moment = None
    if moment is None:
        return math.nan, _WRAP
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp(), _WRAP


def detect_units(table: TelemetryTable) -> TelemetryUnits:
    """Unit, axes and frame of the velocities, from what the drone does: how its height changes, where it leans.

    Without evidence they are the SDK's: dm/s, z down, world of power-on.
    """
    ratio, words = body_frame_evidence(table.stamps_s, table.values)
    units = replace(_vertical_units(table), body_frame=ratio > 0, frame_evidence=words)
    if table.stated.isdisjoint(_VELOCITY):
        return units
    return replace(
        units, velocity_m_s=0.1, evidence=f"the unit of its header line, z {'down' if units.z_down else 'up'}"
    )


def _assumed_units(table: TelemetryTable, units: TelemetryUnits, name: str) -> list[str]:
    """A warning if the SDK's units are assumed of numbers that its drones, which count in whole ones, do not send."""
    known = {*table.stated, *(_VELOCITY if units.velocity_m_s != TelemetryUnits().velocity_m_s else ())}
    whole = {key: bool(np.all(np.nan_to_num(table.values[key]) % 1.0 == 0.0)) for key in table.values}
    doubtful = [key for key in (*_VELOCITY, *_ATTITUDE, "tof", "h") if not whole.get(key, True) and key not in known]
    if not doubtful:
        return []
    return [
        f"{name}: no unit of {', '.join(doubtful)} is stated: taken for dm/s, degrees and cm; write others in the "
        "header line, such as 'vgx (m/s)'"
    ]


def _turned_to_world(values: dict[str, FloatArray]) -> dict[str, FloatArray]:
    yaw = np.radians(values["yaw"])
    c, s, x, y = np.cos(yaw), np.sin(yaw), values["vgx"], values["vgy"]
    return {**values, "vgx": c * x - s * y, "vgy": s * x + c * y}


def _vertical_units(table: TelemetryTable) -> TelemetryUnits:
    """Unit and axes of the velocities, from how range or height changes while the drone climbs and sinks.

    The slope of height over integrated ``vgz`` is -0.1 for dm/s with z down, -0.01 for cm/s, +1 for m/s with z up; the
    nearest of these is taken when the flight's vertical motion is clear, else the SDK's default.
    """
    vz = table.values.get("vgz")
    if vz is None or len(vz) < 20:
        return TelemetryUnits()
    for name, unit in (("tof", 0.01), ("h", 0.01), ("baro", 1.0)):
        z = table.values.get(name)
        if z is None:
            continue
        slope, correlation = _height_slope(table.stamps_s, vz, unit * z, step_m=0.25)
        if abs(correlation) < 0.5 or slope == 0.0 or not math.isfinite(slope):
            continue
        size = min((0.01, 0.1, 1.0), key=lambda s: abs(math.log(abs(slope) / s)))
        words = {0.01: "cm/s", 0.1: "dm/s", 1.0: "m/s"}[size]
        axis = "down" if slope < 0 else "up"
        evidence = f"{name} changes by {slope:+.3f} m per unit*s of vgz (r = {correlation:+.2f}): {words}, z {axis}"
        return TelemetryUnits(size, slope < 0, evidence)
    return TelemetryUnits(evidence="SDK default (dm/s, z down): too little vertical motion to decide")


def _height_slope(stamps_s: FloatArray, vz: FloatArray, z_m: FloatArray, step_m: float) -> tuple[float, float]:
    """Slope and correlation between one-second changes of height and of integrated ``vgz``, without floor steps."""
    good = np.isfinite(vz) & np.isfinite(z_m) & (z_m > 0.12) & (z_m < 8.0)
    t, v, z = stamps_s[good], vz[good], z_m[good]
    if len(t) < 20:
        return math.nan, 0.0
    path = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
    jump = np.concatenate([[0], np.cumsum((np.abs(np.diff(z)) > step_m) | (np.diff(t) > 0.5))])
    late = np.searchsorted(t, t + 1.0)
    inside = late < len(t)
    first, last = np.flatnonzero(inside), late[inside]
    same = (jump[first] == jump[last]) & (t[last] - t[first] < 1.3)
    dx, dz = (path[last] - path[first])[same], (z[last] - z[first])[same]
    moving = np.abs(dx) > 0.3 * float(np.max(np.abs(dx), initial=0.0))
    if moving.sum() < 10:
        return math.nan, 0.0
    x, y = dx[moving], dz[moving]
    if np.ptp(x) == 0.0 or np.ptp(y) == 0.0:  # a frozen sensor: no covariance
        return math.nan, 0.0
    return float(np.median(y / x)), float(np.corrcoef(x, y)[0, 1])


class TelemetryWriter:
    """Append-only `telemetry.csv`; every row is flushed at once and whole.

    An existing file is continued after its last whole line.

    Raises:
        TelemetryError: If the file cannot be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        try:
            before = self.path.read_bytes() if self.path.exists() else b""
            self._file = Appender(self.path, None)
            if not before:
                self._file.write(",".join(HEADER) + "\n")
            elif not before.endswith(b"\n"):
                self._file.write("\n")  # a partial line becomes one malformed row
        except OSError as error:
            raise TelemetryError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def write(self, stamp_s: float, fields: Mapping[str, float | str]) -> None:
        """One state message; missing fields stay empty."""
        cells = [f"{stamp_s:.6f}"]
        for name in FIELDS:
            value = fields.get(name)
            cells.append(f"{value:.10g}" if isinstance(value, float | int) and math.isfinite(value) else "")
        try:
            self._file.write(",".join(cells) + "\n")
        except OSError as error:
            raise TelemetryError(f"{self.path}: cannot be written: {error.strerror or error}") from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> "TelemetryWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
