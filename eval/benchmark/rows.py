"""The benchmark's runs with one change at a time: the ablation's rows, and depth networks beside each other."""

import json
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgeslam_torch.eval.benchmark.benchmark import CASES, FIGURES, BenchSettings, asked, run_rows, sequences
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.conditions import machine, stamp
from edgeslam_torch.eval.experiment.figures import Figure, grouped, markdown_table
from edgeslam_torch.eval.experiment.runner import check_own
from edgeslam_torch.files.atomic import write_text

RECORD = "ablation.json"
DEFAULT = "default"
"""Name of the row that all others are compared with."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the ablation's table."""

    title: str
    set: Sequence[str] = ()
    """``section.key=value`` on top of the defaults."""
    against: str = DEFAULT
    """Name of the row it is compared with."""
    first: str = ""
    """Statement that its process executes before the run, for what no setting changes."""


_TABLE = tomllib.loads(Path(__file__).with_name("ablation.toml").read_text(encoding="utf-8"))
ROWS = {name: Row(**row) for name, row in _TABLE.items()}
"""The table of `edgeslam ablation` by name, top to bottom."""

_JUDGED = ("ate_sim3_m", "ate_online_sim3_m", "map_median_m", "edges_within_2cm", "map_points")
_SHOWN = (*_JUDGED, "coverage", "scale_error_abs", "cpu_ms_per_frame")
JUDGED, COLUMNS = (tuple(f for f in FIGURES if f.name in names) for names in (_JUDGED, _SHOWN))
COLUMNS = (*COLUMNS, Figure("finish_ms", "last refinement [ms]", "{:.0f}"))
_NETWORKS = tuple(f for f in FIGURES if f.name in _SHOWN and f.name not in ("ate_online_sim3_m", "edges_within_2cm"))


def run_ablation(
    settings: BenchSettings, names: Sequence[str], out: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """Run every sequence with every seed and row, and write ``ablation.json``; runs that ``out`` has are not repeated.

    Args:
        settings: What is run.
        names: Of `ROWS`; all when empty. The rows they are compared with are run too.
        out: Folder of the results.
        say: Called with one line for every run.

    Raises:
        EvaluationError: If a row or a sequence does not exist.
        OutputError: If ``out`` holds what no ablation wrote.
    """
    check_own(out, CASES, ("machine", "settings", "rows"), RECORD)
    unknown = [name for name in names if name not in ROWS]
    if unknown:
        raise EvaluationError(f"no row {unknown[0]!r}; there are {', '.join(ROWS)}")
    wanted = set(names or ROWS)
    wanted |= {ROWS[name].against for name in wanted} | {DEFAULT}
    rows = {name: (row.set, row.first) for name, row in ROWS.items() if name in wanted}
    found = run_rows(settings, sequences(settings), rows, out, say)
    kept = {name: {"runs": [_kept(run) for run in found.get(name, [])]} for name in ROWS}
    record = stamp() | {"machine": machine(), "settings": asked(settings), "rows": kept}
    write_text(out / RECORD, json.dumps(record, indent=1) + "\n")
    return record


def _kept(run: dict[str, Any]) -> dict[str, Any]:
    """What the record has of a run."""
    figures = {column.name: run["figures"].get(column.name) for column in COLUMNS}
    return {"sequence": run["sequence"], "seed": run["seed"], "figures": figures, "error": run["error"]}


def markdown_ablation(record: dict[str, Any]) -> str:
    """One table a sequence: medians over the seeds, and whether a row differs from the one it is compared with.

    "worse" and "better" are the row's, beyond the noise (`experiment.figures`); what is not named is the same.
    """
    rows = {name: grouped(row["runs"], "sequence") for name, row in record["rows"].items() if row["runs"]}
    settings = record["settings"]
    frames = "all frames" if settings["max_frames"] is None else f"first {settings['max_frames']} frames"
    parts = [
        f"EdgeSLAM-Torch {record['version']}, {record['made']}, {frames}, seeds "
        f"{' '.join(str(s) for s in settings['seeds'])}, medians; {record['machine']['cores']} x "
        f"{record['machine']['cpu']}"
    ]
    for sequence in rows[DEFAULT]:
        lines = []
        for name, groups in rows.items():
            none = "failed" if any(run["error"] for run in groups[sequence]) else "-"
            cells = [c.cell(c.values(groups[sequence]), none) for c in COLUMNS]
            against = ROWS[name].against
            beside = "" if name == against else f"{against}: {_verdict(rows[against], groups, sequence)}"
            lines.append([ROWS[name].title, *cells, beside])
        parts += ["", f"### {sequence}", "", markdown_table(["", *(c.title for c in COLUMNS), "beside"], lines)]
    return "\n".join(parts) + "\n"


def _verdict(before: dict[str, Any], after: dict[str, Any], sequence: str) -> str:
    found = {f.title.split(" [")[0]: f.change(before[sequence], after[sequence]) for f in JUDGED}
    return ", ".join(f"{title} {change}" for title, change in found.items() if change not in ("", "same")) or "same"


def compare_networks(
    settings: BenchSettings, networks: Sequence[str], out: Path, say: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """The runs once with every depth network: a record of each, by the network's name as ``depth.weights`` takes it.

    Raises:
        OutputError: If ``out`` holds what no benchmark wrote.
    """
    check_own(out, CASES)
    rows = {str(number): ((f"depth.weights={network}",), "") for number, network in enumerate(networks)}
    found = run_rows(settings, sequences(settings), rows, out, say)
    return {network: {"runs": runs} for network, runs in zip(networks, found.values(), strict=True)}


def markdown_networks(records: dict[str, dict[str, Any]]) -> str:
    """A row for every run: figures, and the network's own share of the time; a dash where there is none (no metres, no
    measured depth)."""
    lines = []
    for network, record in records.items():
        for run in record["runs"]:
            depth_ms = run["stages"].get("depth")
            cells = [*(f.cell(f.values([run])) for f in _NETWORKS), "-" if depth_ms is None else f"{depth_ms:.1f}"]
            cells = [f"failed: {run['error']}", *[""] * (len(cells) - 1)] if run["error"] else cells
            lines.append([Path(network).name, f"{run['sequence']}, seed {run['seed']}", *cells])
    return markdown_table(["network", "sequence", *(f.title for f in _NETWORKS), "depth [ms/frame]"], lines) + "\n"
