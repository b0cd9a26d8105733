"""Which column of a table of poses is what: by the names in its header, else by their number."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.files.units import UNITS, known_units, si_per_unit, split_unit

_TIME = re.compile(rf"(?:.*header)?(?:(?:timestamp|time|stamp|t)s?|(?=...))(?P<unit>{'|'.join(UNITS['time'])})?")
_OWNER = r"(?:.*pose|.*transform)?"
_POSITION = re.compile(
    rf"{_OWNER}(?:p|t|pos|position|trans|translation|location)?(?:rsr)?(?P<axis>[xyz])(?P<unit>m|cm|mm)?"
)
_QUATERNION = re.compile(rf"{_OWNER}(?:q|quat|quaternion|r|rot|rotation|orientation)(?:rs)?(?P<axis>[xyzw])")


@dataclass(frozen=True, slots=True)
class Columns:
    """Where a table has times, positions and orientations."""

    time: tuple[tuple[int, float | None], ...]
    """Columns that add up to the time, with seconds per unit; None when the header does not say."""
    position: tuple[int, int, int]
    quaternion: tuple[int, int, int, int] | None
    """In the order x y z w; None for positions alone."""
    metres: float = 1.0
    """Metres per unit of the positions."""


TUM = Columns(((0, None),), (1, 2, 3), (4, 5, 6, 7))
EUROC = Columns(((0, None),), (1, 2, 3), (5, 6, 7, 4))
POSITIONS = Columns(((0, None),), (1, 2, 3), None)


def columns_by_name(names: Sequence[str]) -> Columns | None:
    """Columns by the header's names; None if it names none of them: then their number decides.

    Raises:
        EvaluationError: If only a part of them is named, or one twice.

    Example:
        >>> columns_by_name("num,timestamp [ns],p_x,p_y,p_z,q_w,q_x,q_y,q_z".split(","))
        Columns(time=((1, 1e-09),), position=(2, 3, 4), quaternion=(6, 7, 8, 5), metres=1.0)
    """
    time: dict[str, tuple[int, float | None]] = {}
    axes: dict[str, list[int]] = {}
    metres = set()
    for index, name in enumerate(names):
        base, unit = _split_unit(name)
        if found := _TIME.fullmatch(base):
            time[base] = (index, _in_si("time", unit or found["unit"] or "", name))
        elif found := _POSITION.fullmatch(base):
            axes.setdefault(found["axis"], []).append(index)
            metres.add(_in_si("length", unit or found["unit"] or "", name) or 1.0)
        elif found := _QUATERNION.fullmatch(base):
            axes.setdefault("q" + found["axis"], []).append(index)
    if not axes:
        return None
    position = [axes.get(axis, []) for axis in "xyz"]
    quaternion = [axes.get("q" + axis, []) for axis in "xyzw"]
    complete = all(quaternion)
    if not complete and len(names) == 8:
        return None  # t x y z and four others: a TUM file whose header calls them something else
    missing = [word for word, there in (("time", time), *zip("xyz", position, strict=True)) if not there]
    if missing:
        raise EvaluationError(f"the header names no column for {', '.join(missing)}: {', '.join(names)[:200]}")
    if len(metres) > 1 or any(len(found) > 1 for found in (*position, *(quaternion if complete else ()))):
        raise EvaluationError(f"the header names more than one pose: {', '.join(names)[:200]}")
    x, y, z = (found[0] for found in position)
    qx, qy, qz, qw = (found[0] for found in quaternion) if complete else (0, 0, 0, 0)
    return Columns(_one_time(time), (x, y, z), (qx, qy, qz, qw) if complete else None, metres.pop())


def columns_by_number(count: int, euroc: bool) -> Columns | None:
    """Columns of a table without header; None if no format has as many. EuRoC's quaternions begin with the scalar."""
    if count == 4:
        return POSITIONS
    if count == 8:
        return EUROC if euroc else TUM
    return EUROC if count in (11, 17) else None  # EuRoC: ns, p, q (w first), v, biases


def _one_time(found: dict[str, tuple[int, float | None]]) -> tuple[tuple[int, float | None], ...]:
    """The time, of several columns that could be one: seconds with nanoseconds beside them, else a header's."""
    if sorted(unit or 0.0 for _, unit in found.values()) == [1e-9, 1.0]:
        return tuple(found.values())
    stamped = [place for name, place in found.items() if "header" in name]
    return (*stamped, *found.values())[:1]


def _split_unit(name: str) -> tuple[str, str]:
    """A name reduced to letters and digits, and the unit in brackets after it."""
    base, unit = split_unit(name)
    return re.sub(r"[^a-z0-9]", "", base.lower()), unit


def _in_si(quantity: str, unit: str, name: str) -> float | None:
    """SI units per unit; None where the header states none."""
    if not unit:
        return None
    factor = si_per_unit(quantity, unit)
    if math.isnan(factor):
        raise EvaluationError(f"the unit of {name!r} is not known: {known_units(quantity)}")
    return factor
