"""Units in the headers of tables, with or without brackets."""

import math

from edgeslam_torch.files.time_units import SECONDS_PER_UNIT

GRAVITY_M_S2 = 9.80665
"""Standard gravity."""
_SECOND_NAMES = {
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs millisecond milliseconds",
    "us": "us usec usecs microsecond microseconds \N{MICRO SIGN}s \N{GREEK SMALL LETTER MU}s",
    "ns": "ns nsec nsecs nanosec nanosecs nanosecond nanoseconds",
}
_LENGTHS = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), 1.0),
    "dm": 0.1,
    "cm": 0.01,
    "mm": 1e-3,
    "ft": 0.3048,
    "feet": 0.3048,
    "in": 0.0254,
}
_DEGREE = math.pi / 180
UNITS: dict[str, dict[str, float]] = {
    "time": {name: SECONDS_PER_UNIT[unit] for unit, names in _SECOND_NAMES.items() for name in names.split()},
    "length": _LENGTHS,
    "speed": {
        **{f"{length}/s": metres for length, metres in _LENGTHS.items()},
        "mps": 1.0,
        "km/h": 1 / 3.6,
        "kmh": 1 / 3.6,
        "kph": 1 / 3.6,
        "mph": 0.44704,
        "fps": 0.3048,
        **dict.fromkeys(("kn", "kt", "knots"), 1852 / 3600),
    },
    "angle": {
        **dict.fromkeys(("deg", "degree", "degrees", "\N{DEGREE SIGN}"), _DEGREE),
        **dict.fromkeys(("rad", "radian", "radians"), 1.0),
        "mrad": 1e-3,
    },
    "share": {"%": 0.01, "pct": 0.01, "percent": 0.01},
    "acceleration": {
        "mg": 1e-3 * GRAVITY_M_S2,
        "g": GRAVITY_M_S2,
        "cm/s2": 0.01,
        **dict.fromkeys(("m/s2", "m/s^2", "m/s\N{SUPERSCRIPT TWO}"), 1.0),
    },
}
"""SI units (of a share: 1) per unit, by quantity and name."""


def si_per_unit(quantity: str, unit: str) -> float:
    """SI units per unit; NaN where that is no unit of the quantity.

    Example:
        >>> si_per_unit("speed", "Km / h"), si_per_unit("length", "s")
        (0.2777777777777778, nan)
    """
    return UNITS[quantity].get(unit.strip(" .").lower().replace(" ", "").replace("_", "/"), math.nan)


def known_units(quantity: str) -> str:
    """One name of each unit, for messages."""
    names = {factor: unit for unit, factor in reversed(UNITS[quantity].items())}
    return ", ".join(reversed(names.values()))


def split_unit(header: str) -> tuple[str, str]:
    """A column's name, and the unit in brackets after it; empty without one.

    Example:
        >>> split_unit("Tof (m)"), split_unit("p_x [cm]"), split_unit("yaw_deg")
        (('Tof', 'm'), ('p_x', 'cm'), ('yaw_deg', ''))
    """
    text = header.rstrip()
    start = max(text.rfind("("), text.rfind("["))
    unit = text[start + 1 : -1]
    if start < 0 or not text.endswith((")", "]")) or ")" in unit or "]" in unit:
        return header, ""
    return text[:start].rstrip(" \t_"), unit.strip()
