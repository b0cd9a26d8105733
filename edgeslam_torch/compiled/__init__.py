"""Plain loops compiled by numba: single-threaded, with a fixed order of summation, so that results are reproducible.

A first run compiles, and keeps the machine code in a cache; later runs link it without importing numba, which takes a
second and 60 MB. A compiled function calls compiled functions of its own file only: the cache notices changes of that
file alone. It multiplies no matrices by ``@``, for which numba imports SciPy.
"""

import functools
import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from edgeslam_torch.compiled.signature import parsed

logger = logging.getLogger(__name__)

Function = TypeVar("Function", bound=Callable[..., Any])

_FILES: dict[Path, dict[str, "Loops"]] = {}
"""Functions with declared types, by source file and name."""
_LINKING = threading.Lock()


def compiled(types: str = "") -> Callable[[Function], Function]:
    """The function, compiled with its whole file by the first call of one of them, or by `compile_all`.

    Args:
        types: Of the arguments in numba's notation, as all callers give them; empty for a function that only compiled
            ones call.
    """

    def compile(function: Function) -> Function:
        return cast(Function, Loops(function, types))

    return compile


def compile_all() -> None:
    """Link every imported function, and compile what is not cached: a minute once, in which a camera would not wait."""
    for source in _FILES:
        _link(source)


class Loops:
    """A function of plain loops, called as machine code."""

    def __init__(self, function: Callable[..., Any], types: str) -> None:
        functools.update_wrapper(self, function)
        self.function = function
        self.types = types
        self._parsed = parsed(types) if types else None
        self._source = Path(function.__code__.co_filename)
        self._call: Callable[..., Any] | None = None
        if types:
            _FILES.setdefault(self._source, {})[function.__qualname__] = self

    def __call__(self, *arguments: Any) -> Any:
        if not (self._parsed and self._parsed.fits(arguments)):
            return self._for_any_types(*arguments)
        if self._call is None:
            _link(self._source)
        return self._call(*arguments)  # type: ignore[misc]

    @functools.cached_property
    def _for_any_types(self) -> Callable[..., Any]:
        if self.types:
            logger.warning("%s is compiled for arguments that are not (%s)", self.function.__qualname__, self.types)
        return self.numba

    @functools.cached_property
    def numba(self) -> Any:
        """Numba's function, which compiles for the types that it is called with, in every process again."""
        from edgeslam_torch.compiled.build import dispatcher

        return dispatcher(self.function)

    @property
    def _numba_type_(self) -> Any:
        """Where one function calls another, numba asks for this."""
        return self.numba._numba_type_


def _link(source: Path) -> None:
    """Link the functions of a file, and compile them if they are not cached.

    Where a version of numba has other names for its inner parts than those known here, it compiles and links itself,
    in every process.
    """
    functions = _FILES[source]
    with _LINKING:
        if all(loops._call for loops in functions.values()):
            return
        calls: dict[str, Callable[..., Any]]
        try:
            calls = _machine_code(source, functions)
        except (OSError, ImportError, AttributeError) as error:
            logger.warning("%s is compiled in every run: %s", source.name, error)
            calls = {name: loops.numba for name, loops in functions.items()}
        for name, call in calls.items():
            functions[name]._call = call


def _machine_code(source: Path, functions: dict[str, Loops]) -> dict[str, Callable[..., Any]]:
    """The functions of a file, from the cache if they are in it."""
    from edgeslam_torch.compiled.cache import load, save
    from edgeslam_torch.compiled.machine_code import link

    codes = load(source)
    if codes is None:
        from edgeslam_torch.compiled.build import build

        codes = {name: build(loops.numba, f"({loops.types},)") for name, loops in functions.items()}
        save(source, codes)
    return {name: link(code) for name, code in codes.items()}
