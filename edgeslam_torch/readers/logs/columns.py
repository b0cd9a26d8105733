"""Names and units of the columns of telemetry tables."""

import math
import re

from edgeslam_torch.drone.sdk_state import FIELDS, GRAVITY_M_S2

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
QUANTITIES = {
    "vgx": "speed",
    "vgy": "speed",
    "vgz": "speed",
    "pitch": "angle",
    "roll": "angle",
    "yaw": "angle",
    "tof": "length",
    "h": "length",
    "baro": "altitude",
    "bat": "charge",
    "agx": "acceleration",
    "agy": "acceleration",
    "agz": "acceleration",
}
"""What each field of the SDK is."""
_LENGTHS_M = {
    "cm": 0.01,
    "dm": 0.1,
    "m": 1.0,
    "mm": 1e-3,
    "ft": 0.3048,
    "feet": 0.3048,
    "in": 0.0254,
    "metres": 1.0,
    "meters": 1.0,
}
_SPEEDS_M_S = {
    **{f"{length}/s": metres for length, metres in _LENGTHS_M.items()},
    "mps": 1.0,
    "km/h": 1 / 3.6,
    "kmh": 1 / 3.6,
    "kph": 1 / 3.6,
    "mph": 0.44704,
    "fps": 0.3048,
    "kn": 1852 / 3600,
    "kt": 1852 / 3600,
    "knots": 1852 / 3600,
}
_DEGREE = math.pi / 180
UNITS = {
    "speed": {unit: metres / 0.1 for unit, metres in _SPEEDS_M_S.items()},
    "angle": {
        "deg": 1.0,
        "degree": 1.0,
        "degrees": 1.0,
        "\N{DEGREE SIGN}": 1.0,
        "rad": 1 / _DEGREE,
        "radian": 1 / _DEGREE,
        "radians": 1 / _DEGREE,
        "mrad": 1e-3 / _DEGREE,
    },
    "length": {unit: metres / 0.01 for unit, metres in _LENGTHS_M.items()},
    "altitude": _LENGTHS_M,
    "charge": {"%": 1.0, "pct": 1.0, "percent": 1.0},
    "acceleration": {
        "mg": 1.0,
        "g": 1e3,
        "m/s2": 1e3 / GRAVITY_M_S2,
        "m/s^2": 1e3 / GRAVITY_M_S2,
        "m/s\N{SUPERSCRIPT TWO}": 1e3 / GRAVITY_M_S2,
        "cm/s2": 10.0 / GRAVITY_M_S2,
    },
}
"""Units by quantity: the SDK's units (dm/s, degrees, cm, metres, percent, thousandths of g) per unit."""


def column_of(header: str) -> tuple[str, float, bool] | None:
    """What a column's name says.

    Returns:
        Field of the SDK, SDK units per unit of the column (NaN where a unit is stated that is not known), and whether a
        unit is stated; None where it is no field.

    Example:
        >>> column_of("Tof (m)"), column_of("yaw_deg"), column_of("height")
        (('tof', 100.0, True), ('yaw', 1.0, True), ('h', 1.0, False))
    """
    text = header.strip(" \"'").lower()
    bracket = re.fullmatch(r"(.*?)[\s_]*[(\[]\s*(.*?)\s*[)\]]", text)
    name, unit = (bracket[1], bracket[2]) if bracket else (text, "")
    field = _field(name)
    if field is not None:
        return field, unit_factor(field, unit) if unit else 1.0, bool(unit)
    words = re.split(r"[\s_]+", name)
    for cut in range(len(words) - 1, 0, -1):
        field, unit = _field("_".join(words[:cut])), "/".join(words[cut:])
        factor = math.nan if field is None else unit_factor(field, unit)
        if field is not None and math.isfinite(factor):
            return field, factor, True
    return None


def unit_factor(field: str, unit: str) -> float:
    """SDK units of a field per unit; NaN where that is none of it."""
    return UNITS[QUANTITIES[field]].get(unit.strip(" .").lower().replace(" ", "").replace("_", "/"), math.nan)


def _field(name: str) -> str | None:
    plain = "_".join(name.replace("/", "_").split())
    plain = _ALIASES.get(plain, plain)
    return plain if plain in FIELDS else None
