"""Plain loops compiled by numba: single-threaded, with a fixed order of summation, so that results are reproducible.

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
    """The function, compiled at its first call for the types of its arguments.

    Machine code is cached beside the file or, where that cannot be written, in the user's cache directory
    (``NUMBA_CACHE_DIR`` overrides it); if none is writable, every process compiles again.
    """
    settings: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
    try:
        return cast(Function, numba.njit(cache=True, **settings)(function))
    except RuntimeError:  # no writable cache directory
        return cast(Function, numba.njit(**settings)(function))


class _Notice(event.Listener):
    """Logs once that the first call compiles, which takes long."""

    said = False

    def on_start(self, event: Any) -> None:
        if not self.said:
            self.said = True
            logger.warning("compiling; once on this machine, some seconds")

    def on_end(self, event: Any) -> None:
        pass


event.register("numba:compile", _Notice())
