"""Parser of a command's options: no abbreviations, whole and finite numbers, mistakes in one line."""

import argparse
import math
import sys
from typing import Any, NoReturn

EXIT_USAGE = 2

_SHORT = {"--out": "-o"}
"""Short names of options, the same in all commands."""


class Parser(argparse.ArgumentParser):
    """Suggests corrections; options cannot be abbreviated, so that new options break no script."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        kwargs.setdefault("allow_abbrev", False)
        super().__init__(*args, **kwargs)  # type: ignore[arg-type]
        self.register("type", int, _whole_number)
        self.register("type", float, _finite_number)

    def add_argument(self, *names: str, **options: Any) -> argparse.Action:
        """An option with the short name that it has in every command."""
        short = [_SHORT[name] for name in names if name in _SHORT and _SHORT[name] not in names]
        return super().add_argument(*names, *short, **options)

    def error(self, message: str) -> NoReturn:
        """One line, and exit."""
        sys.stderr.write(f"{self.prog}: error: {message}; see {self.prog} --help\n")
        sys.exit(EXIT_USAGE)

    def options(self) -> list[str]:
        """All options."""
        return [name for action in self._actions for name in action.option_strings]


def _whole_number(text: str) -> int:
    """Argument type for integers."""
    try:
        value = int(text)
    except ValueError:
        value = None
    if value is None or not -(2**31) <= value < 2**31:
        raise argparse.ArgumentTypeError(f"must be a whole number of at most 32 bits, got {text[:40]!r}")
    return value


def _finite_number(text: str) -> float:
    """Argument type for finite floats."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise argparse.ArgumentTypeError(f"must be a finite number, got {text[:40]!r}")
    return value
