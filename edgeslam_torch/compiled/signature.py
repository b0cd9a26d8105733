"""Checks of arguments by their types in numba's notation: ``f8, i8[::1], f8[:, ::1], UniTuple(f8, 4)``."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np


class _Type:
    """``f8``, or with axes the array ``f8[:, ::1]``, in C order."""

    def __init__(self, name: str, python: str = "()", ndim: int | None = None) -> None:
        self.name, self.python, self.ndim = name, python, ndim

    def __getitem__(self, axes: slice | tuple[slice, ...]) -> "_Type":
        return _Type(self.name, ndim=len(axes) if isinstance(axes, tuple) else 1)


_NOTATION = {
    "f8": _Type("f8", "(float, int)"),
    "f4": _Type("f4"),
    "i8": _Type("i8", "(int, integer)"),
    "u1": _Type("u1"),
    "b1": _Type("b1", "(bool, bool_)"),
    "Tuple": list,
    "UniTuple": lambda item, count: [item] * count,
}
_NAMES = {name: np.dtype(name) for name in _NOTATION if "Tuple" not in name} | {
    "ndarray": np.ndarray,
    "integer": np.integer,
    "bool_": np.bool_,
}


def checker(types: str) -> Callable[[tuple[Any, ...]], bool]:
    """Whether arguments are of these types, as machine code takes for granted; written out, as it is called often."""
    conditions = " and ".join(_conditions("a", list(eval(f"({types},)", _NOTATION))))
    check: Callable[[tuple[Any, ...]], bool] = eval(f"lambda a: {conditions}", _NAMES)
    return check


def _conditions(value: str, expected: _Type | list[Any]) -> Iterator[str]:
    if isinstance(expected, list):
        yield f"type({value}) is tuple and len({value}) == {len(expected)}"
        for i, item in enumerate(expected):
            yield from _conditions(f"{value}[{i}]", item)
    elif expected.ndim is None:
        yield f"isinstance({value}, {expected.python})"
    else:
        yield f"type({value}) is ndarray and {value}.dtype == {expected.name}"
        yield f"{value}.ndim == {expected.ndim} and {value}.flags.carray"
