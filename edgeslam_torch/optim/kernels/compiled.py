"""torch.compile for the solver's hot kernels: opt-in, with eager fallback."""

import functools
import logging
from collections.abc import Callable
from typing import Any

import torch

logger = logging.getLogger(__name__)

_compiled: dict[Callable[..., Any], Callable[..., Any]] = {}
_reported: set[str] = set()


def kernel(function: Callable[..., Any], compile: bool) -> Callable[..., Any]:
    """``function``, or its compiled form: compiled for the first sizes, then once more for dynamic sizes.

    Compiling takes seconds to minutes at the first call and needs a C++ compiler (on the CPU). On failure, a warning
    is logged once and the function runs eagerly from then on.

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
            # No compiler, no space, unsupported; or cached code for other sizes, which asserts.
            except (TorchDynamoException, RuntimeError, OSError, AssertionError) as error:
                failed = True
                cause = str(error).strip().split("\n")[0]
                if cause not in _reported:  # without a compiler every kernel fails alike
                    _reported.add(cause)
                    logger.warning("torch.compile failed, eager from now on: %s", cause)
        return function(*args)

    return call
