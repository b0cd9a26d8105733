"""Limits of the figures of cells, as data, and their evaluation."""

import operator
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError

BARS = Path(__file__).with_name("thresholds.toml")
_LIMITS = ("at_least", "at_most", "at_most_times_base")

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Bar:
    """A limit for one figure of some cells."""

    cells: tuple[str, ...]
    """Patterns of names."""
    figure: str
    kind: str
    """``at_least``, ``at_most`` or ``at_most_times_base``."""
    limit: float
    share: float = 1.0
    """Enough when this share of the runs is within the limit."""

    def covers(self, cell: str) -> bool:
        """Whether a cell's name matches."""
        return any(fnmatchcase(cell, pattern) for pattern in self.cells)

    def passes(self, row: Row, base: float | None = None) -> bool:
        """Whether a run is within the limit; a figure that it does not have is not.

        Args:
            row: The run.
            base: Median of the figure over the runs of the cell that it is a variant of; None when there is none.
        """
        value = row["figures"].get(self.figure)
        if value is None:
            return False
        if self.kind == "at_most_times_base":
            return base is not None and bool(value <= self.limit * base)
        compare = operator.ge if self.kind == "at_least" else operator.le
        return bool(compare(value, self.limit))

    def __str__(self) -> str:
        sign = ">=" if self.kind == "at_least" else "<="
        times = " x base" if self.kind == "at_most_times_base" else ""
        return f"{self.figure} {sign} {self.limit:g}{times}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a limit for the runs of some cells."""

    bar: Bar
    passed: int
    runs: int
    worst: float | None
    """The worst figure; None if a run has none."""

    @property
    def ok(self) -> bool:
        """Whether enough of the runs pass."""
        return self.passed >= self.bar.share * self.runs - 1e-9

    def __str__(self) -> str:
        value = "none" if self.worst is None else f"{self.worst:.3g}"
        return f"{self.bar} ({self.passed}/{self.runs}, worst {value})"


def read_bars(path: Path = BARS) -> list[Bar]:
    """Limits of a TOML file; its header describes the format.

    Raises:
        EvaluationError: If it cannot be read or holds something else.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8")).get("bar", [])
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: cannot be read as bars ({error})") from error
    bars = []
    for table in tables:
        cells = tuple(table.get("cells", ()))
        for figure, limit in table.items():
            if figure != "cells":
                bars.append(_bar(cells, figure, limit, path))
    return bars


def _bar(cells: tuple[str, ...], figure: str, limit: Any, path: Path) -> Bar:
    kinds = [k for k in _LIMITS if isinstance(limit, dict) and k in limit]
    if not cells or len(kinds) != 1 or set(limit) - {*kinds, "share"}:
        raise EvaluationError(f"{path}: {figure} needs cells, and one of {', '.join(_LIMITS)}; got {limit!r}")
    return Bar(cells, figure, kinds[0], float(limit[kinds[0]]), float(limit.get("share", 1.0)))


def verdicts_of_cell(cell: str, rows: Sequence[Row], bars: Iterable[Bar]) -> list[Verdict]:
    """How the runs of one cell stand to the bars that every run must pass."""
    own = [row for row in rows if row["cell"] == cell]
    found = [_verdict(bar, own, rows) for bar in bars if bar.share == 1.0 and bar.covers(cell)]
    return [verdict for verdict in found if verdict.runs]


def verdicts_of_groups(rows: Sequence[Row], bars: Iterable[Bar]) -> list[Verdict]:
    """How all runs together stand to the bars that only a share of them must pass."""
    groups = [(bar, [r for r in rows if bar.covers(r["cell"])]) for bar in bars if bar.share < 1.0]
    return [_verdict(bar, covered, rows) for bar, covered in groups if covered]


def _verdict(bar: Bar, covered: Sequence[Row], rows: Sequence[Row]) -> Verdict:
    based = [(row, _base(row, bar.figure, rows)) for row in covered]
    if bar.kind == "at_most_times_base":  # without its base a variant cannot be judged
        based = [(row, base) for row, base in based if base is not None]
        covered = [row for row, _ in based]
    passed = sum(bar.passes(row, base) for row, base in based)
    values = [row["figures"].get(bar.figure) for row in covered]
    known = [v for v in values if v is not None]
    worst = min(known, default=None) if bar.kind == "at_least" else max(known, default=None)
    worst = worst if len(known) == len(values) else None
    return Verdict(bar, passed, len(covered), worst)


def _base(row: Row, figure: str, rows: Sequence[Row]) -> float | None:
    values = [r["figures"].get(figure) for r in rows if r["cell"] == row["base"] and r["cell"] != row["cell"]]
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None
