"""Runs cells in separate processes, some at a time; an interrupted judge resumes."""

import json
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from edgeslam_torch import __version__
from edgeslam_torch.eval.benchmark.conditions import code_state
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.judge.cells import Cell
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.plain import subfolder
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.jobs.watched import Job, Limits, Start, run_each, start_module

CELL, RESULT, LOG = "cell.json", "result.json", "log.txt"
FORMAT = 1
"""Of the record."""


@dataclass(frozen=True, slots=True)
class JudgeSettings:
    """How cells are run."""

    overrides: tuple[str, ...] = ()
    """``section.key=value`` over the default settings of every run."""
    max_frames: int | None = None
    jobs: int = 2
    """Processes at a time."""
    timeout_s: float = 900.0
    """A cell that takes longer is ended."""
    flights: Path | None = None
    """Where simulated flights are recorded, to be used again; ``flights`` in the output folder when None."""


def judge(
    cells: Sequence[Cell],
    settings: JudgeSettings,
    out: Path,
    say: Callable[[str], None],
    commit: str | None = None,
    start: Start | None = None,
) -> dict[str, Any]:
    """Run the cells without a result in ``out``, and gather all results.

    Args:
        cells: What to run.
        settings: How.
        out: Folder for the cells' own folders.
        say: Called with one line for every finished cell.
        commit: State of the code; read from git when None. A result of another state is not taken.
        start: Starts a cell's process; `start_cell` when None.

    Returns:
        The record: conditions, and a row for every cell with its figures, or with the reason why it has none; the
        cells that an earlier call with the same code and settings left in ``out`` are among them.
    """
    commit = code_state() if commit is None else commit
    start = start or start_cell
    rows: dict[Cell, dict[str, Any]] = {}
    waiting: list[Cell] = []
    for cell in cells:
        found = _result(out / "cells" / cell.slug, _key(cell, settings, commit))
        if found is None:
            waiting.append(cell)
        else:
            rows[cell] = _row(cell, found)
    if rows:
        say(f"{len(rows)} of {len(cells)} cells were done before")
    limits = Limits(settings.timeout_s)

    def begin(cell: Cell) -> Job:
        folder = _prepared(cell, settings, commit, out)
        return Job(folder, folder / LOG, start, limits)

    with closing(run_each(waiting, begin, settings.jobs)) as ends:
        for cell, ended in ends:
            found = _result(out / "cells" / cell.slug, _key(cell, settings, commit))
            rows[cell] = _row(cell, {"error": ended.reason} if found is None else found)
            say(f"[{len(rows)}/{len(cells)}] {_one_line(rows[cell])}")
    return {
        "format": FORMAT,
        "version": __version__,
        "commit": commit,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "overrides": list(settings.overrides),
        "max_frames": settings.max_frames,
        "rows": sorted([*rows.values(), *_others(cells, settings, out, commit)], key=_order),
    }


def _order(row: dict[str, Any]) -> tuple[bool, str, int]:
    """Recordings, each before its variants, then simulations."""
    return row["cell"].startswith(("flight/", "none/", "telemetry/")), row["cell"], row["seed"]


def start_cell(folder: Path, log: IO[str]) -> subprocess.Popen[str]:
    """The process that runs a cell's folder."""
    return start_module("edgeslam_torch.eval.judge.run_cell", folder, log)


def _key(cell: Cell, settings: JudgeSettings, commit: str) -> str:
    """Everything that determines a cell's result."""
    return json.dumps([commit, list(settings.overrides), settings.max_frames, cell.to_dict()])


def _result(folder: Path, key: str) -> dict[str, Any] | None:
    """The result in a cell's folder, if it is whole and has this key."""
    try:
        found = read_mapping(folder / RESULT, "JSON", EvaluationError)
    except EvaluationError:
        return None
    return found if found.get("key") == key else None


def _others(cells: Sequence[Cell], settings: JudgeSettings, out: Path, commit: str) -> list[dict[str, Any]]:
    """Rows of results in ``out`` of the same code and settings, of cells not requested now."""
    rows = []
    for path in sorted((out / "cells").glob(f"*/{CELL}")):
        try:
            cell = Cell(**read_mapping(path, "JSON", EvaluationError)["cell"])
        except (TypeError, KeyError, ValueError) as error:
            raise EvaluationError(f"{path}: no cell of a judge ({error}); give another --out") from error
        found = _result(path.parent, _key(cell, settings, commit))
        if cell not in cells and found is not None:
            rows.append(_row(cell, found))
    return rows


def _prepared(cell: Cell, settings: JudgeSettings, commit: str, out: Path) -> Path:
    """The cell's folder, with what its process has to do and no result."""
    folder = subfolder(out, "cells", cell.slug)
    (folder / RESULT).unlink(missing_ok=True)
    flights = settings.flights or out / "flights"
    flights.mkdir(parents=True, exist_ok=True)
    spec = {
        "key": _key(cell, settings, commit),
        "cell": cell.to_dict(),
        "overrides": settings.overrides,
        "max_frames": settings.max_frames,
        "flights": str(flights),
    }
    write_text(folder / CELL, json.dumps(spec, indent=1) + "\n")
    return folder


def _row(cell: Cell, found: dict[str, Any]) -> dict[str, Any]:
    return {
        "cell": cell.name,
        "base": cell.base,
        "seed": cell.seed,
        "figures": found.get("figures", {}),
        "notes": found.get("notes", []),
        "error": found.get("error", ""),
    }


def _one_line(row: dict[str, Any]) -> str:
    name = f"{row['cell']} seed {row['seed']}"
    if row["error"]:
        return f"{name}: {row['error']}"
    f = row["figures"]
    ate = f"ATE {f['ate_m']:.4f} m" if f.get("ate_m") is not None else "no ATE"
    return f"{name}: {ate}, {f['supported_end']:.0%} of {f['frames']:.0f} frames on the map"
