"""Arithmetic as text, with draws from a seed: what stands in scenes and in `furniture.toml` where a number may."""

import ast
from collections.abc import Callable, Mapping
from functools import lru_cache
from types import CodeType, MappingProxyType
from typing import Any

import numpy as np

from edgeslam_torch.errors import ConfigError

Number = float | str
_MAX_STEPS = 1000
_NONE: Mapping[str, Callable[..., Any]] = MappingProxyType({})
_SYNTAX = (
    ast.Expression, ast.BinOp, ast.Add, ast.Sub, ast.Mult, ast.Div, ast.Mod, ast.UnaryOp, ast.USub, ast.Not,
    ast.BoolOp, ast.boolop, ast.Compare, ast.cmpop, ast.IfExp, ast.Call, ast.keyword, ast.Name, ast.Load, ast.Constant,
)  # fmt: skip


class Values:
    """Named numbers, and what text means with them."""

    def __init__(
        self, rng: np.random.Generator, known: Mapping[str, Any], functions: Mapping[str, Callable[..., Any]] = _NONE
    ) -> None:
        """Args: ``known``: the first names, to which `define` adds; ``functions``: more than those of this class."""
        self.known = dict(known)
        self._functions = {
            "__builtins__": {},
            "uniform": lambda low, high: float(rng.uniform(low, high)),
            "normal": lambda mean, sigma: float(rng.normal(mean, sigma)),
            "integers": lambda low, end: int(rng.integers(low, end)),
            "random": rng.random,
            "either": lambda *options: options[int(rng.random() * len(options))],
            "choose": lambda *options: options[int(rng.choice(len(options)))],
            "sample": lambda count, *options: set(rng.choice(np.array(options), count, replace=False).tolist()),
            "steps": _steps,
            "min": min,
            "max": max,
            "round": round,
            "whole": int,
            "exp": np.exp,
            "log": np.log,
            "cos": np.cos,
            "sin": np.sin,
            "pi": np.pi,
            **functions,
        }

    def define(self, values: Mapping[str, Number]) -> None:
        """Draw values in their order; each may use those before it."""
        for name, value in values.items():
            self.known[name] = self(value)

    def __call__(self, value: Any) -> Any:
        """A number, or a list of those that ``steps`` or TOML gave."""
        if isinstance(value, tuple | list):
            return [self(item) for item in value]
        if not isinstance(value, str):
            return value
        try:
            return eval(_compiled(value), self._functions, self.known)
        except NameError as error:
            known = ", ".join([*self.known, *(name for name in self._functions if name != "__builtins__")])
            raise ConfigError(f"{value!r}: {error.name} is not a value; known: {known}") from error
        except (SyntaxError, TypeError, ValueError, ArithmeticError, RecursionError, MemoryError) as error:
            raise ConfigError(f"{value!r} cannot be computed ({error})") from error


@lru_cache(maxsize=4096)
def _compiled(text: str) -> CodeType:
    tree = ast.parse(text, mode="eval")
    for node in ast.walk(tree):
        if not isinstance(node, _SYNTAX) or (isinstance(node, ast.Constant) and isinstance(node.value, str | bytes)):
            raise ConfigError(f"{text!r} is not arithmetic")
    return compile(tree, "scene", "eval")


def _steps(first: float, end: float, step: float) -> list[float]:
    if not (step and 0 <= (end - first) / step <= _MAX_STEPS):
        raise ValueError(f"steps must be from 0 to {_MAX_STEPS}")
    return list(np.arange(first, end, step).tolist())
