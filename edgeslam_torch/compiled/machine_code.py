"""Machine code of compiled functions, linked by LLVM into this process.

It calls C functions of numba's extension modules, which are loaded without the package: its import takes a second.
"""

import builtins
import ctypes
import functools
import importlib.machinery
import importlib.util
import pickle
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from llvmlite import binding as llvm


class MachineCode(NamedTuple):
    """A compiled function with its symbols."""

    object: bytes
    """Relocatable object file."""
    entry: str
    """The C function that Python calls: it unpacks arguments, and packs results."""
    environment: str
    """Variable that points to the constants."""
    constants: list[Any]
    """Python objects that it refers to: dtypes of new arrays."""
    needed: list[str]
    """Functions and variables of Python, numba and the C library."""


def processor() -> tuple[str, str, str]:
    """Platform, name and instructions of this processor."""
    try:
        features = llvm.get_host_cpu_features().flatten()
    except RuntimeError:  # LLVM does not know them on every platform
        features = ""
    return llvm.get_process_triple(), llvm.get_host_cpu_name(), features


def target_machine() -> llvm.TargetMachine:
    """Generator of code for this processor, with all of its instructions."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    triple, cpu, features = processor()
    target = llvm.Target.from_triple(triple)
    reloc = "static" if target.name.startswith("x86") else "default"
    return target.create_target_machine(
        cpu=cpu, features=features, opt=3, reloc=reloc, codemodel="jitdefault", jit=True
    )


def link(code: MachineCode) -> Callable[..., Any]:
    """A function that Python can call; it trusts the types of its arguments.

    Raises:
        OSError: If a symbol is missing.
    """
    _define_symbols()
    # Each has an engine to itself: numba may give one name to different functions in different processes.
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target_machine())
    missing = [name for name in code.needed if not llvm.address_of_symbol(name)]
    if missing:  # LLVM would end the process
        raise OSError(f"machine code needs {', '.join(missing)}: is this version of numba supported?")
    engine.add_object_file(llvm.ObjectFileRef.from_data(code.object))
    engine.finalize_object()
    python = _extension("_dynfunc")
    environment = python.Environment({})
    environment.consts.extend(code.constants)
    ctypes.c_void_p.from_address(engine.get_global_value_address(code.environment)).value = id(environment)
    entry = engine.get_function_address(code.entry)
    function: Callable[..., Any] = python.make_function(sys.modules[__name__], "loops", "", entry, environment, engine)
    return function


@functools.cache
def _define_symbols() -> None:
    helpers, runtime = _extension("_helperlib"), _extension("core.runtime._nrt_python")
    runtime.memsys_use_cpython_allocator()  # as numba does: it may be imported while arrays of ours live
    symbols = {f"{prefix}{name}": address for name, address in helpers.c_helpers.items() for prefix in ("", "numba_")}
    symbols |= {f"NRT_{name}": address for name, address in runtime.c_helpers.items()}
    symbols |= {f"PyExc_{name}": id(value) for name, value in vars(builtins).items() if isinstance(value, type)}
    symbols |= {"_Py_NoneStruct": id(None), "numba_unpickle": ctypes.cast(_unpickled, ctypes.c_void_p).value}
    for name, address in symbols.items():
        llvm.add_symbol(name, address)


@ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p, ctypes.c_int, ctypes.c_void_p)
def _unpickled(data: int, size: int, _digest: int) -> object:
    """Constant of machine code, such as the type of new arrays; numba's own function imports numba."""
    return _loads(ctypes.string_at(data, size))


_loads = functools.cache(pickle.loads)


def numba_folder() -> Path:
    """Folder of numba's package, which is not imported.

    Raises:
        ModuleNotFoundError: If it is not installed.
    """
    package = importlib.util.find_spec("numba")
    if package is None or package.origin is None:
        raise ModuleNotFoundError("No module named 'numba'", name="numba")
    return Path(package.origin).parent


def _extension(name: str) -> Any:
    """Extension module of numba."""
    name = f"numba.{name}"
    if name not in sys.modules:
        _, *folders, last = name.split(".")
        spec = importlib.machinery.PathFinder.find_spec(last, [str(numba_folder().joinpath(*folders))])
        spec = importlib.util.spec_from_file_location(name, spec.origin if spec else None)
        if spec is None or spec.loader is None:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        spec.loader.exec_module(importlib.util.module_from_spec(spec))
    return sys.modules[name]
