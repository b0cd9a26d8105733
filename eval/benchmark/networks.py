"""Depth networks beside each other: what each costs, and what map and metres the SLAM makes with it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from edgeslam_torch.eval.benchmark.benchmark import BenchSettings, run_benchmark

COLUMNS = (
    ("ATE Sim(3) [m]", "ate_sim3_m", "{:.4f}"),
    ("frames with a pose", "coverage", "{:.1%}"),
    ("map points", "map_points", "{:.0f}"),
    ("map, median [m]", "map_median_m", "{:.4f}"),
    ("scale off", "scale_error_abs", "{:.1%}"),
    ("CPU [ms/frame]", "cpu_ms_per_frame", "{:.1f}"),
)
"""Title, name among a run's figures, format."""


def compare_networks(
    settings: BenchSettings, networks: Sequence[str], out: Path, say: Callable[[str], None]
) -> dict[str, dict[str, Any]]:
    """The benchmark once with every network, each into a folder of its own.

    Args:
        settings: What is run.
        networks: As ``depth.weights`` takes them.
        out: Folder of the runs.
        say: Told one line before and after every run.

    Returns:
        The record of each benchmark by the network's name.
    """
    records = {}
    for number, network in enumerate(networks):
        say(f"depth network {network}")
        chosen = replace(settings, overrides=(*settings.overrides, f"depth.weights={network}"), micro=False)
        records[network] = run_benchmark(chosen, out / f"network{number}", say)
    return records


def markdown_networks(records: dict[str, dict[str, Any]]) -> str:
    """A row for every run: figures, and the network's own share of the time; a dash where there is none (no metres, no
    measured depth)."""
    titles = ["network", "sequence", *(title for title, _, _ in COLUMNS), "depth [ms/frame]"]
    lines = ["| " + " | ".join(titles) + " |", "|---|---|" + "---:|" * (len(titles) - 2)]
    for network, record in records.items():
        for run in record["runs"]:
            cells = [Path(network).name, f"{run['sequence']}, seed {run['seed']}"]
            if run["error"]:
                lines.append(f"| {cells[0]} | {cells[1]} | failed: {run['error']} |" + " |" * (len(titles) - 3))
                continue
            figures = {**run["figures"], "depth": run["stages"].get("depth")}
            for name, form in [*((name, form) for _, name, form in COLUMNS), ("depth", "{:.1f}")]:
                cells.append("-" if figures.get(name) is None else form.format(figures[name]))
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"
