"""What each loss does: the benchmark repeated with one thing changed at a time, and what that changed."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.benchmark import BenchSettings, compare, read_record, run_benchmark
from edgeslam_torch.eval.errors import EvaluationError

DEFAULT = "default"
"""Name of the row that all others are compared with."""

_CORNERS = ("window.angle=arms", "window.collinearity=relative")


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    name: str
    title: str
    overrides: tuple[str, ...]
    """``section.key=value`` on top of the defaults."""
    against: str = DEFAULT
    """Name of the row it is compared with."""


ROWS = (
    Row(DEFAULT, "default", ()),
    Row("points", "points alone: no edge term", ("window.alignment=false", "window.cycle=off")),
    Row("no-reprojection", "no reprojection loss", ("window.reprojection=off",)),
    Row("no-alignment", "no edge alignment", ("window.alignment=false",)),
    Row("no-cycle", "no cycle loss", ("window.cycle=off",)),
    Row("corners", "with L-shape loss (angle and collinearity)", _CORNERS),
    Row("corners-no-angle", "L-shape without angle", ("window.collinearity=relative",), "corners"),
    Row("corners-no-collinearity", "L-shape without collinearity", ("window.angle=arms",), "corners"),
    Row("literal-reprojection", "literal reprojection (eqs. 15-16)", ("window.reprojection=literal",)),
    Row("literal-cycle", "literal cycle (eqs. 17-23)", ("window.cycle=literal", "window.adaptive=false")),
    Row("cosine-angle", "cosine across views for the arms", ("window.angle=cosine", _CORNERS[1]), "corners"),
    Row("literal-angle", "literal angle (eqs. 24-25)", ("window.angle=literal", _CORNERS[1]), "corners"),
    Row(
        "literal-collinearity", "literal collinearity (eq. 26)", (_CORNERS[0], "window.collinearity=literal"), "corners"
    ),
    Row(
        "literal-total",
        "the paper's total (eq. 28), all literal",
        (
            "window.reprojection=literal",
            "window.alignment=false",
            "window.cycle=literal",
            "window.angle=literal",
            "window.collinearity=literal",
            "window.adaptive=false",
        ),
    ),
    Row("fixed-weights", "fixed weights: no adaptive scales", ("window.adaptive=false",)),
    Row("no-depth-network", "no depth network", ("depth.weights=none",)),
)
"""The table of `edgeslam ablation`, top to bottom."""

_COLUMNS = (
    ("ate_sim3_m", "ATE Sim(3) [mm]", 1e3, "{:.1f}"),
    ("map_median_m", "map error [mm]", 1e3, "{:.1f}"),
    ("edges_within_2cm", "edges in 2 cm", 1e2, "{:.0f} %"),
    ("scale_error_abs", "scale off", 1e2, "{:.1f} %"),
    ("cpu_ms_per_frame", "CPU [ms/frame]", 1.0, "{:.0f}"),
)
_JUDGED = ("ate_sim3_m", "map_median_m", "edges_within_2cm")
_SHORT = {"ate_sim3_m": "ATE", "map_median_m": "map", "edges_within_2cm": "edges found"}


def run_ablation(
    settings: BenchSettings, names: Sequence[str], out: Path, say: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """Run the rows one after the other, each as a benchmark in its own folder.

    A row that an earlier call finished in ``out``, with the same settings and commit, is read and not run again.

    Args:
        settings: Sequences, seeds and length; its overrides go under every row's own.
        names: Names of `ROWS`; all when empty. The rows they are compared with are run too.
        out: Folder of the rows' folders.
        say: Told one line before and after every run.

    Returns:
        The benchmark's record of every row, by name, in the order of `ROWS`.

    Raises:
        EvaluationError: For a name that is no row, or a sequence that is not there.
    """
    known = {row.name: row for row in ROWS}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise EvaluationError(f"no row {unknown[0]!r}; there are {', '.join(known)}")
    wanted = set(names or known)
    wanted |= {known[name].against for name in wanted} | {DEFAULT}
    records = {}
    for row in (row for row in ROWS if row.name in wanted):
        mine = replace(settings, overrides=(*settings.overrides, *row.overrides), micro=False)
        say(f"{row.title} ...")
        folder = out / row.name
        records[row.name] = _finished(folder / "bench.json", mine) or run_benchmark(mine, folder, say)
    return records


def markdown_ablation(records: dict[str, dict[str, Any]]) -> str:
    """One table a sequence: medians over the seeds, and whether a row differs from the one it is compared with.

    "worse" and "better" are the row's, beyond twice the seeds' scatter and the benchmark's floor (`compare`);
    what is not named is the same.
    """
    rows = [row for row in ROWS if row.name in records]
    if not rows:
        return ""
    first = next(iter(records.values()))
    frames = "all frames" if first["max_frames"] is None else f"first {first['max_frames']} frames"
    parts = [
        f"EdgeSLAM-Torch {first['version']} {first['commit']}, {first['made']}, {frames}, seeds "
        f"{' '.join(str(s) for s in first['seeds'])}, medians; {first['machine']['cores']} x {first['machine']['cpu']}"
    ]
    for sequence in dict.fromkeys(run["sequence"] for run in first["runs"]):
        titles = ["", *(title for _, title, _, _ in _COLUMNS), "beside"]
        parts += ["", f"### {sequence}", "", "| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
        for row in rows:
            cells = [_cell(records[row.name], sequence, *column) for column in _COLUMNS]
            parts.append(f"| {row.title} | " + " | ".join([*cells, _verdict(records, row, sequence)]) + " |")
    return "\n".join(parts) + "\n"


def _finished(path: Path, settings: BenchSettings) -> dict[str, Any] | None:
    """The record of an earlier call that did exactly this, to the end."""
    if not path.is_file():
        return None
    record = read_record(path)
    same = (
        record["overrides"] == list(settings.overrides)
        and record["seeds"] == list(settings.seeds)
        and record["max_frames"] == settings.max_frames
        and record["mode"] == settings.mode
    )
    sequences = {run["sequence"] for run in record["runs"]}
    judged = all(run["figures"] or run["error"] for run in record["runs"])
    complete = (
        len(record["runs"]) == len(sequences) * len(settings.seeds) and set(settings.only or sequences) == sequences
    )
    return record if same and judged and complete else None


def _cell(record: dict[str, Any], sequence: str, name: str, _title: str, factor: float, text: str) -> str:
    runs = [run for run in record["runs"] if run["sequence"] == sequence]
    found = [run["figures"][name] for run in runs if run["figures"].get(name) is not None]
    if not found:
        return "failed" if any(run["error"] for run in runs) else "-"
    return text.format(factor * float(np.median(found)))


def _verdict(records: dict[str, dict[str, Any]], row: Row, sequence: str) -> str:
    if row.name == row.against or row.against not in records:
        return ""
    found = compare(records[row.against], records[row.name])
    told = [
        f"{_SHORT[c['metric']]} {c['verdict']}"
        for c in found
        if c["sequence"] == sequence and c["metric"] in _JUDGED and c["verdict"] != "same"
    ]
    return f"{row.against}: {', '.join(told) or 'same'}"
