"""A batch as one table: CSV for spreadsheets, JSON for programs."""

import csv
import io
import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch import __version__
from edgeslam_torch.eval.experiment.figures import Figure
from edgeslam_torch.eval.metrics.run_score import finite
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.fleet.folder import RECORD, TABLE

DONE, FAILED, WAITING = "done", "failed", "waiting"
FORMAT = 1
"""Of the record."""


COLUMNS = (
    Figure("frames", "frames", "{:.0f}"),
    Figure("tracked", "tracked %", "{:.1f}", 100.0),
    Figure("lost", "lost", "{:.0f}"),
    Figure("pieces", "pieces", "{:.0f}"),
    Figure("ate_m", "ATE, Sim(3) [cm]", "{:.2f}", 100.0),
    Figure("ate_metric_m", "ATE, SE(3) [cm]", "{:.2f}", 100.0),
    Figure("online_m", "live ATE [cm]", "{:.2f}", 100.0),
    Figure("scale_error", "scale - 1 [%]", "{:+.1f}", 100.0),
    Figure("scale_sigma", "its sigma [%]", "{:.1f}", 100.0),
    Figure("scale_source", "scale from", "{:.0f}"),
    Figure("map_median_m", "map error [cm]", "{:.1f}", 100.0),
    Figure("edge_points", "edge points", "{:.0f}"),
    Figure("fps", "frames/s", "{:.1f}"),
    Figure("cpu_ms", "CPU ms", "{:.0f}"),
    Figure("memory_mb", "MB", "{:.0f}"),
)
"""Figures of `run_flight.figures` that the page shows, in its order."""


def cell(figure: Figure, value: Any) -> str:
    """A figure in words; empty when there is none."""
    return value if isinstance(value, str) else figure.cell([value], none="")


@dataclass(frozen=True, slots=True)
class Row:
    """One flight."""

    name: str
    state: str
    """`DONE`, `FAILED` or `WAITING`."""
    reason: str
    """Why it has no figures; empty when it has."""
    recording: str
    folder: str = ""
    """Of the run, below the batch's; empty without one."""
    log: str = ""
    picture: str = ""
    attempts: int = 1
    figures: dict[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        """One line."""
        again = f", attempt {self.attempts}" if self.attempts > 1 else ""
        if self.state != DONE:
            return f"{self.name}: {self.state}{again}: {self.reason}"
        f = self.figures
        ate = f", ATE {100 * f['ate_m']:.1f} cm" if f.get("ate_m") is not None else ""
        return f"{self.name}: {f['tracked']:.0%} of {f['frames']} frames tracked{ate}{again}"


def write_tables(folder: Path, rows: Sequence[Row]) -> None:
    """Write ``batch.csv`` and ``batch.json``."""
    record = {
        "format": FORMAT,
        "version": __version__,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "counts": counts(rows),
        "medians": medians(rows),
        "flights": [asdict(row) for row in rows],
    }
    write_text(folder / RECORD, json.dumps(finite(record), indent=1) + "\n")
    write_text(folder / TABLE, _csv(rows))


def counts(rows: Sequence[Row]) -> dict[str, int]:
    """Flights in each state."""
    return {state: sum(row.state == state for row in rows) for state in (DONE, FAILED, WAITING)}


def medians(rows: Sequence[Row]) -> dict[str, float]:
    """Median of every numeric figure over the flights that have it."""
    found = {}
    for column in COLUMNS:
        values = [row.figures.get(column.name) for row in rows]
        numbers = [v for v in values if isinstance(v, int | float) and math.isfinite(v)]
        if numbers:
            found[column.name] = float(np.median(numbers))
    return found


def _csv(rows: Sequence[Row]) -> str:
    """Figures in their own units (metres, shares), one line a flight."""
    names = list(dict.fromkeys(name for row in rows for name in row.figures))
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["name", "state", "reason", *names, "attempts", "recording", "folder", "notes"])
    for row in rows:
        values = [_plain(row.figures.get(name)) for name in names]
        own = [row.name, row.state, row.reason, *values, row.attempts, row.recording, row.folder, "; ".join(row.notes)]
        writer.writerow([_no_formula(cell) for cell in own])
    return text.getvalue()


def _plain(value: Any) -> Any:
    return "" if value is None or (isinstance(value, float) and not math.isfinite(value)) else value


def _no_formula(cell: Any) -> Any:
    """Text that a spreadsheet would take for a formula, such as a recording called ``=cmd()``, stays text.

    Spreadsheets skip blanks before a formula, and take the signs of full width for the plain ones.
    """
    return f"'{cell}" if isinstance(cell, str) and cell.lstrip()[:1] in tuple("=+-@\uff1d\uff0b\uff0d\uff20") else cell
