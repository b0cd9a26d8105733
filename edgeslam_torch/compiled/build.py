"""Compilation by numba."""

import functools
import logging
from collections.abc import Callable
from typing import Any

import numba
from llvmlite import binding as llvm
from numba.core import sigutils

from edgeslam_torch.compiled.machine_code import MachineCode, target_machine

logger = logging.getLogger(__name__)


def dispatcher(function: Callable[..., Any]) -> Any:
    """Numba's function."""
    return numba.njit(nogil=True, error_model="numpy")(function)


def build(function: Any, types: str) -> MachineCode:
    """Machine code of a function of numba's for arguments of some types."""
    _notify()
    function.compile(types)
    arguments, _ = sigutils.normalize_signature(types)
    compiled = function.overloads[arguments]
    module = llvm.parse_assembly(function.inspect_llvm(arguments))
    symbols = (*module.functions, *module.global_variables)
    return MachineCode(
        target_machine().emit_object(module),
        compiled.fndesc.llvm_cpython_wrapper_name,
        compiled.fndesc.env_name,
        compiled.environment.consts,
        [symbol.name for symbol in symbols if symbol.is_declaration and not symbol.name.startswith("llvm.")],
    )


@functools.cache
def _notify() -> None:
    logger.warning("compiling; once on this machine, a minute or less")
