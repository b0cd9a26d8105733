"""Plain loops compiled by numba: single-threaded, with a fixed order of summation, so that results are reproducible.

A compiled function calls compiled functions of its own file only: numba's cache notices changes of that file alone.
It multiplies no matrices by ``@``: numba would import SciPy for it, a fifth of the memory and time of a start.
"""

import importlib
import logging
import sys
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core import event

logger = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])

_TYPED: list[tuple[Any, str]] = []
"""Functions with the types of their arguments."""


def compiled(types: str = "") -> Callable[[Function], Function]:
    """The function, compiled at its first call, or by `compile_all` for the types of its arguments.

    Machine code is cached beside the file or, where that cannot be written, in the user's cache directory
    (``NUMBA_CACHE_DIR`` overrides it); if none is writable, every process compiles again.

    Args:
        types: Of the arguments in numba's notation, as all callers give them; empty for a function that only compiled
            ones call.
    """

    def compile(function: Function) -> Function:
        settings: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
        try:
            loops = numba.njit(cache=True, **settings)(function)
        except RuntimeError:  # no writable cache directory
            loops = numba.njit(**settings)(function)
        if types:
            _TYPED.append((loops, f"({types},)"))
        return cast(Function, loops)

    return compile


def compile_all() -> None:
    """Compile every imported function that is not cached: a minute once, in which a camera would not wait."""
    for loops, types in _TYPED:
        loops.compile(types)


def _load_without_blas() -> None:
    """Load the part of numba that imports SciPy for its BLAS if there is one, and otherwise does without."""
    blas = "scipy.linalg.cython_blas"
    if blas not in sys.modules:
        sys.modules[blas] = None  # type: ignore[assignment]
        importlib.import_module("numba.np.arraymath")
        del sys.modules[blas]


class _Notice(event.Listener):
    """Logs once that the first call compiles, which takes long."""

    said = False

    def on_start(self, event: Any) -> None:
        if not self.said:
            self.said = True
            logger.warning("compiling; once on this machine, a minute or less")

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Notice())
_load_without_blas()
