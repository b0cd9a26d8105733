"""Limits of the figures of cells, as data, and their evaluation."""

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError

THRESHOLDS = Path(__file__).with_name("thresholds.toml")
_LIMITS = ("at_least", "at_most", "at_most_times_base")

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Threshold:
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

    def passes(self, value: float | None, base: float | None = None) -> bool:
        """Whether a run's figure is within the limit; one that it does not have is not.

        Args:
            value: The figure.
            base: Its median over the runs of the cell that the run's is a variant of; None when there is none.
        """
        if value is None or (self.kind == "at_most_times_base" and base is None):
            return False
        limit = self.limit * base if base is not None and self.kind == "at_most_times_base" else self.limit
        return value >= limit if self.kind == "at_least" else value <= limit

    def __str__(self) -> str:
        sign = ">=" if self.kind == "at_least" else "<="
        times = " x base" if self.kind == "at_most_times_base" else ""
        return f"{self.figure} {sign} {self.limit:g}{times}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """Result of a limit for the runs of some cells."""

    threshold: Threshold
    passed: int
    runs: int
    worst: float | None
    """The worst figure; None if a run has none."""

    @property
    def ok(self) -> bool:
        """Whether enough of the runs pass."""
        return self.passed >= self.threshold.share * self.runs - 1e-9

    def __str__(self) -> str:
        value = "none" if self.worst is None else f"{self.worst:.3g}"
        return f"{self.threshold} ({self.passed}/{self.runs}, worst {value})"


def read_thresholds(path: Path = THRESHOLDS) -> list[Threshold]:
    """Limits of a TOML file; its header describes the format.

    Raises:
        EvaluationError: If it cannot be read or holds something else.
    """
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8")).get("threshold", [])
    except (OSError, tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: cannot be read as thresholds ({error})") from error
    return [
        _threshold(tuple(table.get("cells", ())), figure, limit, path)
        for table in tables
        for figure, limit in table.items()
        if figure != "cells"
    ]


def _threshold(cells: tuple[str, ...], figure: str, limit: Any, path: Path) -> Threshold:
    kinds = [k for k in _LIMITS if isinstance(limit, dict) and k in limit]
    if not cells or len(kinds) != 1 or set(limit) - {*kinds, "share"}:
        raise EvaluationError(f"{path}: {figure} needs cells, and one of {', '.join(_LIMITS)}; got {limit!r}")
    return Threshold(cells, figure, kinds[0], float(limit[kinds[0]]), float(limit.get("share", 1.0)))


def verdicts_of_cell(cell: str, rows: Sequence[Row], thresholds: Iterable[Threshold]) -> list[Verdict]:
    """Verdicts of one cell on thresholds that every run must pass."""
    own = [row for row in rows if row["cell"] == cell]
    found = [_verdict(t, own, rows) for t in thresholds if t.share == 1.0 and t.covers(cell)]
    return [verdict for verdict in found if verdict.runs]


def verdicts_of_groups(rows: Sequence[Row], thresholds: Iterable[Threshold]) -> list[Verdict]:
    """Verdicts of all runs on thresholds that only a share of them must pass."""
    found = [_verdict(t, [row for row in rows if t.covers(row["cell"])], rows) for t in thresholds if t.share < 1.0]
    return [verdict for verdict in found if verdict.runs]


def _verdict(threshold: Threshold, covered: Sequence[Row], rows: Sequence[Row]) -> Verdict:
    pairs = [(row["figures"].get(threshold.figure), _base(row, threshold.figure, rows)) for row in covered]
    if threshold.kind == "at_most_times_base":  # without its base a variant cannot be judged
        pairs = [(value, base) for value, base in pairs if base is not None]
    known = [value for value, _ in pairs if value is not None]
    worst = min(known, default=None) if threshold.kind == "at_least" else max(known, default=None)
    passed = sum(threshold.passes(*pair) for pair in pairs)
    return Verdict(threshold, passed, len(pairs), worst if len(known) == len(pairs) else None)


def _base(row: Row, figure: str, rows: Sequence[Row]) -> float | None:
    values = [r["figures"].get(figure) for r in rows if r["cell"] == row["base"] and r["cell"] != row["cell"]]
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None
