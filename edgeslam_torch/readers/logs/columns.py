"""Names and units of the columns of telemetry tables."""

import math
import re

from edgeslam_torch.drone.sdk_state import FIELDS
from edgeslam_torch.files.units import si_per_unit, split_unit

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
_SPEED, _ANGLE, _LENGTH = ("speed", 0.1), ("angle", math.pi / 180), ("length", 0.01)
_ACCELERATION = ("acceleration", si_per_unit("acceleration", "mg"))
QUANTITIES = {
    **dict.fromkeys(("vgx", "vgy", "vgz"), _SPEED),
    **dict.fromkeys(("pitch", "roll", "yaw"), _ANGLE),
    **dict.fromkeys(("tof", "h"), _LENGTH),
    "baro": ("length", 1.0),
    "bat": ("share", 0.01),
    **dict.fromkeys(("agx", "agy", "agz"), _ACCELERATION),
}
"""Quantity of each SDK field and its SDK unit in SI: dm/s, degrees, cm, metres, percent, thousandths of g."""


def column_of(header: str) -> tuple[str, float, bool] | None:
    """Field and unit by a column's name.

    Returns:
        Field of the SDK, SDK units per unit of the column (NaN where a unit is stated that is not known), and whether a
        unit is stated; None where it is no field.

    Example:
        >>> column_of("Tof (m)"), column_of("yaw_deg"), column_of("height")
        (('tof', 100.0, True), ('yaw', 1.0, True), ('h', 1.0, False))
    """
    name, unit = split_unit(header.strip(" \"'").lower())
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
    quantity, sdk_unit = QUANTITIES[field]
    return si_per_unit(quantity, unit) / sdk_unit


def _field(name: str) -> str | None:
    plain = "_".join(name.replace("/", "_").split())
    plain = _ALIASES.get(plain, plain)
    return plain if plain in FIELDS else None
