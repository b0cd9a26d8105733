"""Plain loops compiled by numba: one thread, sums in the order in which they are written, on every processor alike.

A compiled function calls compiled functions of its own file only: numba's cache notices changes of that file alone.
"""

import logging
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
from numba.core import event

logger = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """The function, compiled at its first call for the types that it is given.

    Machine code is cached beside the file or, where that cannot be written, in the user's cache directory
    (``NUMBA_CACHE_DIR`` chooses another); where none can be written, every process compiles anew.
    """
    settings: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        return cast(Function, numba.njit(cache=True, **settings)(function))
    except RuntimeError:  # no directory that can be written
        return cast(Function, numba.njit(**settings)(function))


class _Notice(event.Listener):
    """Says once that a first call takes long."""

    said = False

    def on_start(self, event: Any) -> None:
        if not self.said:
            self.said = True
            logger.warning("compiling the solver; once on this machine, some seconds")

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Notice())
