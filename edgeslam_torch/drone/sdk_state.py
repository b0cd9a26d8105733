"""The Tello SDK's state messages, units and axes. Degrees, centimetres and decimetres exist only here."""

import math
from collections.abc import Mapping

import numpy as np

from edgeslam_torch.types import TelemetrySample

FIELDS = ("vgx", "vgy", "vgz", "pitch", "roll", "yaw", "tof", "h", "baro", "bat", "agx", "agy", "agz")
"""The fields that `telemetry.csv` keeps, in its order."""
GRAVITY_M_S2 = 9.80665
_RANGES = {
    "vgx": (-200.0, 200.0),
    "vgy": (-200.0, 200.0),
    "vgz": (-200.0, 200.0),
    "pitch": (-360.0, 360.0),
    "roll": (-360.0, 360.0),
    "yaw": (-360.0, 360.0),
    "tof": (0.0, 800.0),
    "h": (-10_000.0, 100_000.0),
    "baro": (-1000.0, 10_000.0),
    "bat": (0.0, 100.0),
}
"""Valid ranges; other values (such as tof 6553, out of range) count as missing."""
_MAX_LINE = 2048


def parse_state(packet: bytes | str) -> dict[str, float | str]:
    """Fields of one state message; unreadable fields are omitted, so the worst packet gives an empty dictionary.

    Reads both forms: SDK 1.3 (``pitch:0;roll:0;...``) and SDK 2.0 with mission pads (``mid:-1;...;mpry:0,0,0;...``).

    Example:
        >>> parse_state("mid:-1;mpry:0,0,0;pitch:3;vgx:-2;baro:147.94;")["vgx"]
        -2.0
    """
    text = packet.decode("ascii", errors="replace") if isinstance(packet, bytes) else packet
    fields: dict[str, float | str] = {}
    for part in text[:_MAX_LINE].strip("\x00 \r\n").split(";"):
        name, colon, value = part.partition(":")
        name, value = name.strip(), value.strip()
        if not colon or not name.isidentifier():
            continue
        number = to_number(value)
        if math.isfinite(number):
            fields[name] = number
        elif value and value.isascii() and value.isprintable():
            fields[name] = value
    return fields


def to_number(text: str) -> float:
    """A finite number, or NaN for anything else (Python's ``1_000`` and ``infinity`` are no numbers here)."""
    try:
        value = float(text) if "_" not in text else math.nan
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


def sample_from_sdk(
    stamp_s: float, fields: Mapping[str, float | str], velocity_unit_m_s: float = 0.1, z_down: bool = True
) -> TelemetrySample:
    """SI units and our axes from SDK fields.

    Args:
        stamp_s: Arrival time [s].
        fields: SDK names to values; text, NaN and values that no Tello sends count as missing.
        velocity_unit_m_s: Metres per second of one unit of ``vgx``; 0.1 according to three real flights.
        z_down: Whether the SDK's axes are north-east-down like (x forward, y right, z down, yaw clockwise), as the
            flights say; False keeps the numbers (x forward, y left, z up).
    """
    flip = np.array([1.0, -1.0, -1.0]) if z_down else np.ones(3)

    def value(name: str) -> float:
        number = fields.get(name, math.nan)
        if not isinstance(number, float | int) or not math.isfinite(number):
            return math.nan
        low, high = _RANGES.get(name, (-1e9, 1e9))
        return float(number) if low <= number <= high else math.nan

    velocity = np.array([value("vgx"), value("vgy"), value("vgz")])
    rpy = np.radians([value("roll"), value("pitch"), value("yaw")])
    force = np.array([value("agx"), value("agy"), value("agz")])
    return TelemetrySample(
        stamp_s,
        velocity_unit_m_s * flip * velocity,
        flip * rpy,
        0.01 * value("h"),
        0.01 * value("tof"),
        value("baro"),
        1e-3 * GRAVITY_M_S2 * flip * force,
        0.01 * value("bat"),
    )
