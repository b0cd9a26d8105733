"""The judge's record as a table that is Markdown too, one line a cell and every run below it; limits of its figures."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.figures import grouped, markdown_table
from edgeslam_torch.eval.judge.score import COLUMNS
from edgeslam_torch.files.record_files import read_mapping

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
    found = []
    for table in read_mapping(path, "TOML", EvaluationError).get("threshold", []):
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


_FOOTNOTES = (
    "end, live: share of the frames whose pose rests on the map, at the end and when they came. path: ATE in % of the "
    "true path. still: ATE of the best fixed position. scale: true over estimated; sigma as the run states it, z = log "
    "scale / sigma. 1st scale s: when the published unit first became the drone's metre, its z; >3 sigma: share of "
    "the frames from 12.5 s on whose live scale is further off. 1st s: error of the first second's poses, and how many "
    "times that of the others it is. Lengths in "
    "metres unless they say otherwise; ATE after Sim(3) over all frames.",
    "Maps of recordings are judged against depth maps nearer than 5 m, those of simulations against the true surfaces. "
    "7scenes_redkitchen's depth maps are not registered to colour by its makers: the transformation was fitted to its "
    "own images (readers/layouts/seven_scenes.py), so that a few mm of its map's distances are that fit's.",
    "CPU is user and system time of the whole process a frame, start-up included and judging left out; in ORB, the "
    "same in passes of ORB over one 640 x 480 image, timed before and after the run. Variants also decode the frames "
    "that they leave out.",
)


def markdown(record: dict[str, Any], thresholds: Sequence[Threshold]) -> str:
    """Medians and thresholds, what passed, footnotes, and every run when there are several a cell."""
    rows = record["rows"]
    cells = grouped(rows, "cell")
    header = ["cell", *(c.title for c in COLUMNS), "thresholds"]
    found = {name: verdicts(rows, thresholds, name) for name in cells}
    lines = [[name, *_cells(own), _passed(own, found[name])] for name, own in cells.items()]
    outcomes = [line[-1] for line in lines if line[-1] != "-"]
    parts = [_conditions(record), "", markdown_table(header, lines), ""]
    parts += [f"{outcomes.count('pass')} of {len(outcomes)} cells with thresholds pass."]
    parts += [f"- {_run_name(row)}: no result: {row['error']}" for row in rows if row["error"]]
    failed = {name: "; ".join(str(v) for v in of_cell if not v.ok) for name, of_cell in found.items()}
    parts += [f"- {name}: {limits}" for name, limits in failed.items() if limits]
    for v in verdicts(rows, thresholds):
        word, covered = "pass" if v.ok else "FAIL", ", ".join(v.threshold.cells)
        parts.append(f"- {covered}: {v.threshold} in {v.threshold.share:.0%}: {v.passed} of {v.runs}, {word}")
    notes = [f"- {_run_name(row)}: {note}" for row in rows for note in row["notes"]]
    parts += ["", *notes] if notes else []
    parts += ["", *_FOOTNOTES]
    if len(rows) > len(cells):
        parts += ["", "Every run:", "", markdown_table(header[:-1], [[_run_name(row), *_cells([row])] for row in rows])]
    return "\n".join(parts) + "\n"


def _conditions(record: dict[str, Any]) -> str:
    seeds = len({row["seed"] for row in record["rows"]})
    changed = f", {' '.join(record['overrides'])}" if record["overrides"] else ", default settings"
    frames = f", the first {record['max_frames']} frames" if record["max_frames"] else ""
    return f"EdgeSLAM-Torch {record['commit']}, {record['made']}, {seeds} seed(s){changed}{frames}"


def _passed(own: Sequence[Row], found: Sequence[Verdict]) -> str:
    if errors := sum(bool(row["error"]) for row in own):
        return f"FAIL {errors} of {len(own)} runs"
    failed = sum(not v.ok for v in found)
    return (f"FAIL {failed} of {len(found)}" if failed else "pass") if found else "-"


def _cells(rows: Sequence[Row]) -> list[str]:
    return [figure.cell(figure.values(rows)) for figure in COLUMNS]


def _run_name(row: Row) -> str:
    return f"{row['cell']} seed {row['seed']}"
