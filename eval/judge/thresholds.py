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
_SIGNS = {"at_least": ">=", "at_most": "<=", "at_most_times_base": "<="}

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

    def __str__(self) -> str:
        times = " x base" if self.kind == "at_most_times_base" else ""
        return f"{self.figure} {_SIGNS[self.kind]} {self.limit:g}{times}"


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
    found = []
    for table in tables:
        cells = tuple(table.pop("cells", ()))
        for figure, limit in table.items():
            kinds = [kind for kind in _SIGNS if isinstance(limit, dict) and kind in limit]
            if not cells or len(kinds) != 1 or set(limit) - {*kinds, "share"}:
                raise EvaluationError(f"{path}: {figure} needs cells, and one of {', '.join(_SIGNS)}; got {limit!r}")
            found.append(Threshold(cells, figure, kinds[0], float(limit[kinds[0]]), float(limit.get("share", 1.0))))
    return found


def verdicts(rows: Sequence[Row], thresholds: Iterable[Threshold], cell: str | None = None) -> list[Verdict]:
    """Verdicts of one cell on the thresholds that every run must pass; without a cell, of all runs on those that only a
    share of them must pass."""
    found = []
    for threshold in (t for t in thresholds if (t.share == 1.0) == (cell is not None)):
        covered = [row for row in rows if threshold.covers(row["cell"]) and cell in (None, row["cell"])]
        found.append(_verdict(threshold, covered, rows))
    return [verdict for verdict in found if verdict.runs]


def _verdict(threshold: Threshold, covered: Sequence[Row], rows: Sequence[Row]) -> Verdict:
    """Figures against their limits; a missing figure fails, and a variant without its base is not judged."""
    pairs = [(row["figures"].get(threshold.figure), threshold.limit) for row in covered]
    if threshold.kind == "at_most_times_base":
        bases = [_base(row, threshold.figure, rows) for row in covered]
        pairs = [(v, limit * base) for (v, limit), base in zip(pairs, bases, strict=True) if base is not None]
    sign = -1.0 if threshold.kind == "at_least" else 1.0
    known = [(value, sign * value <= sign * limit) for value, limit in pairs if value is not None]
    worst = max((value for value, _ in known), key=lambda v: sign * v, default=None)
    return Verdict(threshold, sum(ok for _, ok in known), len(pairs), worst if len(known) == len(pairs) else None)


def _base(row: Row, figure: str, rows: Sequence[Row]) -> float | None:
    """Median of a figure over the runs of the cell that the row's is a variant of."""
    values = [r["figures"].get(figure) for r in rows if r["cell"] == row["base"] and r["cell"] != row["cell"]]
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None
