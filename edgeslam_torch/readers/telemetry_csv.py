"""`telemetry.csv`: a flight's state messages, in the SDK's own names and units, on the clock of the frames.

The reader also accepts other logs: other column names, milliseconds, units and axes inferred from the data.
"""

import logging
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

import numpy as np

from edgeslam_torch.drone.sdk_state import FIELDS, sample_from_sdk, to_number
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.files.appender import Appender
from edgeslam_torch.readers.velocity_frame import body_frame_evidence
from edgeslam_torch.types import FloatArray, TelemetrySample

logger = logging.getLogger(__name__)

HEADER = ("stamp_s", *FIELDS)
_STAMPS = {
    "stamp_s": 1.0,
    "time_s": 1.0,
    "timestamp_s": 1.0,
    "timestamp_ms": 1e-3,
    "time_ms": 1e-3,
    "stamp_ms": 1e-3,
    "ms": 1e-3,
    "timestamp_us": 1e-6,
    "timestamp_ns": 1e-9,
    "timestamp": 0.0,
    "time_stamp": 0.0,
    "stamp": 0.0,
    "t": 0.0,
    "ts": 0.0,
    "datetime": 0.0,
    "date_time": 0.0,
    "time": 0.0,
}
"""Column names of the clock, most reliable first; factor 0: unit inferred from the spacing. The SDK's ``time`` counts
whole seconds of motor time and is the last resort."""
_ALIASES = {
    "vx": "vgx",
    "vy": "vgy",
    "vz": "vgz",
    "speed_x": "vgx",
    "speed_y": "vgy",
    "speed_z": "vgz",
    "ax": "agx",
    "ay": "agy",
    "az": "agz",
    "batt": "bat",
    "battery": "bat",
    "height": "h",
    "barometer": "baro",
    "tof_distance": "tof",
    "distance_tof": "tof",
}
_UNITS = ("cm", "dm", "m", "deg", "degrees", "pct", "percent", "%", "cm_s", "dm_s", "m_s", "mg", "c")
"""Unit suffixes of column names in other logs; the unit of velocities is inferred from the data regardless."""
_VELOCITY = ("vgx", "vgy", "vgz")
_ATTITUDE = ("pitch", "roll", "yaw")
_SEPARATORS = ",;\t"
_MAX_COLUMNS = 256
_MAX_BYTES = 512 * 1024 * 1024


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
        said = []
        if self.skipped:
            rows = len(self.stamps_s) + self.skipped
            said.append(f"{name}: {self.skipped} of {rows} rows left out, malformed or not newer than the row before")
        for what, names in (("velocity", _VELOCITY), ("attitude", _ATTITUDE)):
            columns = [self.values.get(n) for n in names]
            known = [c is not None and bool(np.isfinite(c).any()) for c in columns]
            if not all(known):
                said.append(f"{name}: holds no {what} ({', '.join(names)}), which the scale from telemetry needs")
        return said


def read_telemetry(path: Path, units: TelemetryUnits | None = None) -> tuple[list[TelemetrySample], list[str]]:
    """Telemetry of a flight in SI units, in time order, and warnings about the file.

    Args:
        path: Our ``telemetry.csv`` or another log with a header line.
        units: How to read the velocities; default: `detect_units`.

    Raises:
        TelemetryError: If the file is not there, is not text, or has no clock or no known column.
    """
    table = read_table(path)
    if units is None:
        units = detect_units(table)
        logger.info(
            "%s: velocities: %s; %s", path, units.evidence, units.frame_evidence or "frame: SDK default (world)"
        )
    return table.samples(units), table.warnings(path.name)


def read_table(path: Path) -> TelemetryTable:
    """The known columns, row by row; malformed rows are counted and skipped.

    Raises:
        TelemetryError: As `read_telemetry`.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise TelemetryError(f"{path}: larger than any flight; is this telemetry?")
        text = path.read_text(encoding="utf-8-sig", errors="strict")
    except UnicodeDecodeError as error:
        raise TelemetryError(f"{path}: not a text file; telemetry is comma-separated text") from error
    except OSError as error:
        raise TelemetryError(f"{path}: cannot be read: {error.strerror or error}") from error
    lines = text.splitlines()
    header_at = next((i for i, line in enumerate(lines) if line.strip()), None)
    if header_at is None:
        raise TelemetryError(f"{path}: empty; it needs a header line such as {','.join(HEADER[:4])},...")
    separator = max(_SEPARATORS, key=lines[header_at].count)
    names = [_plain(name) for name in lines[header_at].lstrip("#").split(separator)]
    clock = next((name for name in _STAMPS if name in names), None)
    columns: dict[str, int] = {}
    for i, name in enumerate(names[:_MAX_COLUMNS]):
        known = next((n for n in (name, _ALIASES.get(name, ""), _bare(name)) if n in FIELDS), None)
        if known is not None and name != clock:
            columns.setdefault(known, i)
    if clock is None or not columns:
        missing = f"no clock ({', '.join(_STAMPS)})" if clock is None else f"no known column ({', '.join(FIELDS)})"
        raise TelemetryError(f"{path}: {missing} in its header line; give a telemetry.csv")
    rows, skipped = _rows(lines[header_at + 1 :], separator, len(names), names.index(clock), list(columns.values()))
    table = np.array(rows, dtype=np.float64).reshape(len(rows), 1 + len(columns))
    stamps = table[:, 0] * (_STAMPS[clock] or _seconds_per_unit(table[:, 0]))
    values: dict[str, FloatArray] = {name: table[:, 1 + i] for i, name in enumerate(columns)}
    return TelemetryTable(stamps, values, skipped)


def _plain(name: str) -> str:
    """A column's name without quotes, brackets, case and slashes: ``"Tof (cm)"`` to ``tof_cm``."""
    return "_".join(re.sub(r"[\"'()\[\]]", " ", name).replace("/", "_").lower().split())


def _bare(name: str) -> str:
    """The name without its unit."""
    for unit in sorted(_UNITS, key=len, reverse=True):
        if name.endswith(f"_{unit}"):
            short = name.removesuffix(f"_{unit}")
            return _ALIASES.get(short, short)
    return ""


def _rows(
    lines: list[str], separator: str, width: int, clock: int, columns: list[int]
) -> tuple[list[list[float]], int]:
    rows: list[list[float]] = []
    skipped, last = 0, -math.inf
    for line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = [cell.strip().strip("\"'") for cell in line.split(separator)]
        if len(cells) == width + 1 and not cells[-1]:
            cells.pop()  # a separator at the end of each row
        stamp = _moment(cells[clock]) if len(cells) == width else math.nan
        if not stamp > last or abs(stamp) > 1e19:
            skipped += 1
            continue
        rows.append([stamp, *(to_number(cells[i]) for i in columns)])
        last = stamp
    return rows, skipped


def _moment(text: str) -> float:
    """A number, or Unix seconds of a date and time (UTC unless stated)."""
    number = to_number(text)
    if math.isfinite(number) or len(text) < 16:
        return number
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return math.nan
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _seconds_per_unit(stamps: FloatArray) -> float:
    """A Tello sends at 10 Hz: the spacing distinguishes seconds, milliseconds, microseconds and nanoseconds."""
    if len(stamps) < 2:
        return 1.0
    spacing = float(np.median(np.diff(stamps)))
    return next((unit for unit, limit in ((1.0, 5.0), (1e-3, 5e3), (1e-6, 5e6)) if spacing < limit), 1e-9)


def detect_units(table: TelemetryTable) -> TelemetryUnits:
    """Unit, axes and frame of the velocities, from what the drone does: how its height changes, where it leans.

    Without evidence they are the SDK's: dm/s, z down, world of power-on.
    """
    ratio, words = body_frame_evidence(table.stamps_s, table.values)
    return replace(_vertical_units(table), body_frame=ratio > 0, frame_evidence=words)


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
    return TelemetryUnits(evidence="SDK default (dm/s, z down): too little vertical motion to tell")


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
