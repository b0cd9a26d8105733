"""The benchmark's runs with one change at a time: the ablation's rows, and depth networks beside each other."""

import json
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgeslam_torch import __version__
from edgeslam_torch.eval.benchmark.benchmark import BenchSettings, run_rows
from edgeslam_torch.eval.benchmark.compare import compare
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.conditions import machine
from edgeslam_torch.eval.experiment.figures import Figure
from edgeslam_torch.eval.report.tables import markdown_table
from edgeslam_torch.files.atomic import write_text

DEFAULT = "default"
"""Name of the row that all others are compared with."""


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the ablation's table."""

    title: str
    set: tuple[str, ...] = ()
    """``section.key=value`` on top of the defaults."""
    against: str = DEFAULT
    """Name of the row it is compared with."""
    first: str = ""
    """Statement that its process executes before the run, for what no setting changes."""


ROWS = {
    name: Row(row["title"], tuple(row.get("set", ())), row.get("against", DEFAULT), row.get("first", ""))
    for name, row in tomllib.loads(Path(__file__).with_name("ablation.toml").read_text(encoding="utf-8")).items()
}
"""The table of `edgeslam ablation` by name, top to bottom."""

COLUMNS = (
    Figure("ate_sim3_m", "ATE [mm]", "{:.1f}", 1e3),
    Figure("ate_online_sim3_m", "online [mm]", "{:.1f}", 1e3),
    Figure("map_median_m", "map error [mm]", "{:.1f}", 1e3),
    Figure("edges_within_2cm", "edges in 2 cm", "{:.0f} %", 1e2),
    Figure("map_points", "points", "{:.0f}"),
    Figure("supported", "supported", "{:.0f} %", 1e2),
    Figure("scale_error_abs", "scale off", "{:.1f} %", 1e2),
    Figure("cpu_ms_per_frame", "CPU [ms/frame]", "{:.0f}"),
    Figure("finish_ms", "last refinement [ms]", "{:.0f}"),
)
_JUDGED = ("ate_sim3_m", "ate_online_sim3_m", "map_median_m", "edges_within_2cm", "map_points")
_NETWORKS = (
    Figure("ate_sim3_m", "ATE Sim(3) [m]"),
    Figure("coverage", "frames with a pose", "{:.1%}"),
    Figure("map_points", "map points", "{:.0f}"),
    Figure("map_median_m", "map, median [m]"),
    Figure("scale_error_abs", "scale off", "{:.1%}"),
    Figure("cpu_ms_per_frame", "CPU [ms/frame]", "{:.1f}"),
    Figure("depth", "depth [ms/frame]", "{:.1f}"),
)


def run_ablation(
    settings: BenchSettings, names: Sequence[str], out: Path, say: Callable[[str], None]
) -> dict[str, Any]:
    """Run every sequence with every seed and row; runs that an earlier call left in ``out`` are not repeated.

    Args:
        settings: What is run.
        names: Of `ROWS`; all when empty. The rows they are compared with are run too.
        out: Folder of ``ablation.json``.
        say: Called with one line for every run.

    Returns:
        The record: conditions, and for every row by name its runs with their figures.

    Raises:
        EvaluationError: If a row or a sequence does not exist.
    """
    unknown = [name for name in names if name not in ROWS]
    if unknown:
        raise EvaluationError(f"no row {unknown[0]!r}; there are {', '.join(ROWS)}")
    wanted = set(names or ROWS)
    wanted |= {ROWS[name].against for name in wanted} | {DEFAULT}
    rows = {name: (row.set, row.first) for name, row in ROWS.items() if name in wanted}
    records = run_rows(settings, rows, out, say)
    record = {
        "version": __version__,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "machine": machine(),
        "settings": {
            "seeds": list(settings.seeds),
            "max_frames": settings.max_frames,
            "overrides": list(settings.overrides),
        },
        "rows": {
            name: {"runs": [_kept(run) for run in records[name]["runs"]] if name in records else []} for name in ROWS
        },
    }
    write_text(out / "ablation.json", json.dumps(record, indent=1) + "\n")
    return record


def _kept(run: dict[str, Any]) -> dict[str, Any]:
    """What the record has of a run."""
    figures = {c.name: run["figures"].get("coverage" if c.name == "supported" else c.name) for c in COLUMNS}
    return {"sequence": run["sequence"], "seed": run["seed"], "figures": figures, "error": run["error"]}


def markdown_ablation(record: dict[str, Any]) -> str:
    """One table a sequence: medians over the seeds, and whether a row differs from the one it is compared with.

    "worse" and "better" are the row's, beyond twice the seeds' scatter and the benchmark's floor (`compare`);
    what is not named is the same.
    """
    records = {name: row for name, row in record["rows"].items() if row["runs"]}
    settings = record["settings"]
    frames = "all frames" if settings["max_frames"] is None else f"first {settings['max_frames']} frames"
    parts = [
        f"EdgeSLAM-Torch {record['version']}, {record['made']}, {frames}, seeds "
        f"{' '.join(str(s) for s in settings['seeds'])}, medians; {record['machine']['cores']} x "
        f"{record['machine']['cpu']}"
    ]
    for sequence in dict.fromkeys(run["sequence"] for row in records.values() for run in row["runs"]):
        lines = []
        for name, row in records.items():
            runs = [run for run in row["runs"] if run["sequence"] == sequence]
            none = "failed" if any(run["error"] for run in runs) else "-"
            cells = [c.cell([run["figures"].get(c.name) for run in runs], none) for c in COLUMNS]
            lines.append([ROWS[name].title, *cells, _verdict(records, name, sequence)])
        parts += ["", f"### {sequence}", "", markdown_table(["", *(c.title for c in COLUMNS), "beside"], lines)]
    return "\n".join(parts) + "\n"


def _verdict(records: dict[str, dict[str, Any]], name: str, sequence: str) -> str:
    against = ROWS[name].against
    if name == against or against not in records:
        return ""
    found = [c for c in compare(records[against], records[name]) if c["sequence"] == sequence]
    told = [f"{c['title'].split(' [')[0]} {c['verdict']}" for c in found if c["metric"] in _JUDGED]
    return f"{against}: {', '.join(text for text in told if not text.endswith(' same')) or 'same'}"


def compare_networks(
    settings: BenchSettings, networks: Sequence[str], out: Path, say: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """The runs once with every depth network: a record of each, by the network's name as ``depth.weights`` takes it."""
    rows = {str(number): ((f"depth.weights={network}",), "") for number, network in enumerate(networks)}
    return dict(zip(networks, run_rows(settings, rows, out, say, min_hz=15.0).values(), strict=True))


def markdown_networks(records: dict[str, dict[str, Any]]) -> str:
    """A row for every run: figures, and the network's own share of the time; a dash where there is none (no metres, no
    measured depth)."""
    lines = []
    for network, record in records.items():
        for run in record["runs"]:
            figures = {**run["figures"], "depth": run["stages"].get("depth")}
            cells = [c.cell([figures.get(c.name)]) for c in _NETWORKS]
            cells = [f"failed: {run['error']}", *[""] * (len(cells) - 1)] if run["error"] else cells
            lines.append([Path(network).name, f"{run['sequence']}, seed {run['seed']}", *cells])
    return markdown_table(["network", "sequence", *(c.title for c in _NETWORKS)], lines) + "\n"
