"""Two records side by side: ratios of medians, and what got worse by more than the noise of seeds."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.judge.runner import FORMAT
from edgeslam_torch.eval.judge.table import aligned
from edgeslam_torch.eval.judge.thresholds import Row
from edgeslam_torch.files.record_files import read_mapping

RECORD = "judge.json"
_SIGMAS = 2.0
_MAX_NAMED = 8
"""Maximum number of cells of only one record that are named."""


@dataclass(frozen=True, slots=True)
class Compared:
    """A compared figure."""

    figure: str
    title: str
    text: str
    lower_is_better: bool
    floor: float
    """Difference below which two medians count as equal: relative for errors, absolute for shares."""
    one_seed: float
    """The same for a record with one seed: two standard deviations of a difference of two runs, measured with three
    seeds on two recordings (tum_fr1_xyz, 7scenes_redkitchen); recordings with tracking losses scatter more."""
    relative: bool = True


COMPARED = (
    Compared("supported_end", "end", "{:.1%}", False, 0.005, 0.005, relative=False),
    Compared("supported_live", "live", "{:.1%}", False, 0.005, 0.01, relative=False),
    Compared("losses", "lost", "{:.0f}", True, 0.5, 0.5, relative=False),
    Compared("ate_m", "ATE", "{:.4f}", True, 0.03, 0.05),
    Compared("online_m", "online", "{:.4f}", True, 0.03, 0.16),
    Compared("rotation_deg", "rot °", "{:.2f}", True, 0.03, 0.28),
    Compared("map_points", "points", "{:.0f}", False, 0.05, 0.05),
    Compared("map_median_m", "median", "{:.4f}", True, 0.03, 0.80),
    Compared("map_within_5cm", "5 cm", "{:.0%}", False, 0.02, 0.08, relative=False),
    Compared("cpu_ms", "CPU ms", "{:.1f}", True, 0.10, 0.10),
)


def read_record(folder: Path) -> dict[str, Any]:
    """The record in a judge's output folder.

    Raises:
        EvaluationError: If there is none.
    """
    path = folder / RECORD
    record = read_mapping(path, "JSON", EvaluationError)
    rows = record.get("rows")
    if record.get("format") != FORMAT or not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise EvaluationError(f"{path}: not a result of 'edgeslam judge' (format {FORMAT})")
    return record


def verdict(compared: Compared, before: Sequence[float], after: Sequence[float]) -> str:
    """``better``, ``worse`` or ``same``: whether two medians differ by more than the seeds' scatter and the floor.

    Two medians differ by chance by ``2 sqrt(s_a^2 / n_a + s_b^2 / n_b)``, as in the benchmark.
    """
    a, b = np.asarray(before, dtype=np.float64), np.asarray(after, dtype=np.float64)
    first, second = float(np.median(a)), float(np.median(b))
    size = abs(first) if compared.relative else 1.0
    floor = size * (compared.one_seed if min(len(a), len(b)) == 1 else compared.floor)
    scatter = sum(float(np.var(x, ddof=1)) / len(x) for x in (a, b) if len(x) > 1)
    change = second - first
    if abs(change) <= max(floor, _SIGMAS * float(np.sqrt(scatter))):
        return "same"
    return "worse" if (change > 0) == compared.lower_is_better else "better"


def markdown_against(before: dict[str, Any], after: dict[str, Any]) -> str:
    """Both records' medians and their ratio, cell by cell, ``!`` where it got worse and ``+`` where better."""
    names = [n for n in _names(after) if n in _names(before)]
    worse: list[str] = []
    lines = [[name, *(_side_by_side(name, c, before, after, worse) for c in COMPARED)] for name in names]
    header = ["cell", *(c.title for c in COMPARED)]
    parts = [f"{before['commit']} -> {after['commit']}, medians, ratio; ! worse, + better by more than the noise"]
    parts += ["", aligned(header, lines), ""]
    missing = sorted(set(_names(before)) ^ set(_names(after)))
    named = ", ".join(missing) if len(missing) <= _MAX_NAMED else f"{len(missing)} cells"
    parts += [f"only in one of the two: {named}"] if missing else []
    parts += [f"worse: {', '.join(worse) if worse else 'nothing'}"]
    if any(len(_rows(record, name)) == 1 for record in (before, after) for name in names):
        parts += [
            "cells with one seed: noise as measured on two recordings; CPU time also depends on the machine's load"
        ]
    return "\n".join(parts) + "\n"


def _side_by_side(
    name: str, compared: Compared, before: dict[str, Any], after: dict[str, Any], worse: list[str]
) -> str:
    a, b = (_values(record, name, compared.figure) for record in (before, after))
    if not a and not b:
        return "-"
    if not a or not b:
        if not b:
            worse.append(f"{name} {compared.title} (none any more)")
        return " -> ".join(compared.text.format(np.median(x)) if x else "-" for x in (a, b)) + ("" if b else " !")
    first, second = float(np.median(a)), float(np.median(b))
    found = verdict(compared, a, b)
    mark = {"worse": " !", "better": " +", "same": ""}[found]
    ratio = f" x{second / first:.2f}" if compared.relative and first > 0 else ""
    if found == "worse":
        worse.append(f"{name} {compared.title}{ratio}")
    return f"{compared.text.format(first)} -> {compared.text.format(second)}{ratio}{mark}"


def _names(record: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(row["cell"] for row in record["rows"]))


def _rows(record: dict[str, Any], name: str) -> list[Row]:
    return [row for row in record["rows"] if row["cell"] == name]


def _values(record: dict[str, Any], name: str, figure: str) -> list[float]:
    found = (row["figures"].get(figure) for row in _rows(record, name))
    return [float(v) for v in found if v is not None]
