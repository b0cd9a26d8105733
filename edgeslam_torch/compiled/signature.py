"""Types of arguments in numba's notation: ``f8, i8[::1], f8[:, ::1], UniTuple(f8, 4)``."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np


class _Array(NamedTuple):
    """In C order, aligned and writable."""

    dtype: np.dtype[Any]
    ndim: int

    def fits(self, value: Any) -> bool:
        return type(value) is np.ndarray and (value.dtype, value.ndim) == self and value.flags.carray


class _Scalar:
    """With axes, ``f8[:, ::1]``, an array."""

    def __init__(self, name: str, *accepted: type) -> None:
        self.name, self.accepted = name, accepted

    def __getitem__(self, axes: slice | tuple[slice, ...]) -> _Array:
        return _Array(np.dtype(self.name), len(axes) if isinstance(axes, tuple) else 1)

    def fits(self, value: Any) -> bool:
        return isinstance(value, self.accepted)


class Types:
    """Of all arguments, or of the elements of a tuple."""

    def __init__(self, items: Iterable["_Array | _Scalar | Types"]) -> None:
        self.items = tuple(items)

    def fits(self, values: Any) -> bool:
        """Whether values are of these types, as machine code takes for granted."""
        if type(values) is not tuple or len(values) != len(self.items):
            return False
        return all(item.fits(value) for item, value in zip(self.items, values, strict=True))


_NOTATION = {
    "f8": _Scalar("f8", float, int),
    "f4": _Scalar("f4"),
    "i8": _Scalar("i8", int, np.integer),
    "u1": _Scalar("u1"),
    "b1": _Scalar("b1", bool, np.bool_),
    "Tuple": Types,
    "UniTuple": lambda item, count: Types([item] * count),
}


def parsed(notation: str) -> Types:
    """One type or several."""
    return Types(eval(f"({notation},)", _NOTATION))
