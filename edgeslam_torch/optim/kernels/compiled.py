"""torch.compile for the solver's hot kernels: only when asked for, and eager wherever it fails."""

import functools
import logging
from collections.abc import Callable
from typing import Any

import torch

logger = logging.getLogger(__name__)

_compiled: dict[Callable[..., Any], Callable[..., Any]] = {}
_reported: set[str] = set()


def kernel(function: Callable[..., Any], compile: bool) -> Callable[..., Any]:
    """``function``, or its compiled form; compiled for the sizes it first sees, then once more for any sizes.

    Compiling takes seconds to minutes at the first call and needs a C++ compiler (on the CPU). Where it fails, a
    warning says so once and the function runs as it is from then on.

    Args:
        function: A function of tensors without state and without branches on their values.
        compile: Whether to compile it.
    """
    if not compile:
        return function
    if function not in _compiled:
        _compiled[function] = _with_fallback(function, torch.compile(function))
    return _compiled[function]


def _with_fallback(function: Callable[..., Any], fast: Callable[..., Any]) -> Callable[..., Any]:
    from torch._dynamo.exc import TorchDynamoException

    failed = False

    @functools.wraps(function)
    def call(*args: Any) -> Any:
        nonlocal failed
        if not failed:
            try:
                return fast(*args)
            # No compiler, no space, not supported; or the cache on disk gave code made for other sizes, which asserts.
            except (TorchDynamoException, RuntimeError, OSError, AssertionError) as error:
                failed = True
                cause = str(error).strip().split("\n")[0]
                if cause not in _reported:  # without a compiler every kernel fails alike
                    _reported.add(cause)
                    logger.warning("torch.compile failed, eager from now on: %s", cause)
        return function(*args)

    return call
