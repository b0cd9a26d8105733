"""The judge: all cells in processes of their own, and one record of their figures; an interrupted judge resumes."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.conditions import code_state, stamp
from edgeslam_torch.eval.experiment.runner import CASE, Local, Runner, Task, check_own, run_all
from edgeslam_torch.eval.judge.cells import Cell
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.jobs.watched import Limits

RECORD, TABLE = "judge.json", "judge.md"
FORMAT = 1
"""Of the record."""
CELLS, COMMANDS = "cells", "commands"
"""Folders of the cells' folders, and of the commands that a release runs."""


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
    runner: Runner | None = None,
) -> dict[str, Any]:
    """Run the cells without a result in ``out``, and gather all results.

    Args:
        cells: What to run.
        settings: How.
        out: Folder of the results.
        say: Called with one line for every finished cell.
        commit: State of the code; read from git when None. A result of another state is not taken.
        runner: `Local` when None.

    Returns:
        The record: conditions, and a row for every cell with its figures, or with the reason why it has none; the
        cells that an earlier call with the same code and settings left in ``out`` are among them.

    Raises:
        OutputError: If ``out`` holds what no judge wrote.
    """
    check_own(out, CELLS, ("format", "rows"), RECORD, TABLE, COMMANDS)
    commit = code_state() if commit is None else commit
    flights = settings.flights or out / "flights"
    flights.mkdir(parents=True, exist_ok=True)
    how = {"overrides": list(settings.overrides), "max_frames": settings.max_frames}

    def task(cell: Cell) -> Task:
        case = {"commit": commit, **how, "cell": asdict(cell)}
        run = "edgeslam_torch.eval.judge.run_cell:run_cell"
        own = f"{cell.name.replace('/', '__')}-s{cell.seed}"
        return Task(out / CELLS, own, run, case, {"flights": str(flights)})

    runner = runner or Local(settings.jobs, Limits(settings.timeout_s))
    rows = run_all({cell: task(cell) for cell in cells}, runner, _row, _one_line, say)
    others = [cell for cell in _cells_in(out) if cell not in rows]
    rows |= {cell: _row(cell, found) for cell in others if (found := task(cell).result()) is not None}
    return {"format": FORMAT, **stamp(commit), **how, "rows": sorted(rows.values(), key=_order)}


def _order(row: dict[str, Any]) -> tuple[bool, str, int]:
    """Recordings, each before its variants, then simulations."""
    return row["cell"].startswith(("flight/", "none/", "telemetry/")), row["cell"], row["seed"]


def _cells_in(out: Path) -> list[Cell]:
    """Cells with a folder in ``out``."""
    cells = []
    for path in sorted((out / CELLS).glob(f"*/{CASE}")):
        try:
            cells.append(Cell(**read_mapping(path, "JSON", EvaluationError)["cell"]))
        except (TypeError, KeyError, ValueError) as error:
            raise EvaluationError(f"{path}: no cell of a judge ({error}); give another --out") from error
    return cells


def _row(cell: Cell, found: dict[str, Any] | None, error: str = "") -> dict[str, Any]:
    found = {"figures": {}, "notes": []} | (found or {})
    own = {"cell": cell.name, "base": cell.base, "seed": cell.seed}
    return own | {"figures": found["figures"], "notes": found["notes"], "error": error}


def _one_line(cell: Cell, row: dict[str, Any]) -> str:
    name = f"{cell.name} seed {cell.seed}"
    if row["error"]:
        return f"{name}: {row['error']}"
    f = row["figures"]
    ate = f"ATE {f['ate_m']:.4f} m" if f.get("ate_m") is not None else "no ATE"
    return f"{name}: {ate}, {f['supported_end']:.0%} of {f['frames']:.0f} frames on the map"
