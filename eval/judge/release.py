"""One release's results as data: which runs its documents quote, and their figures in one record."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch import __version__
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.conditions import machine
from edgeslam_torch.eval.inputs.dataset import find_recordings
from edgeslam_torch.eval.judge.cells import CASES, Cell, list_cells
from edgeslam_torch.eval.judge.runner import COMMANDS as FOLDER
from edgeslam_torch.eval.judge.table import Row
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.record_files import is_record, read_mapping

RUNS: dict[str, int] = CASES["release"]["cells"]
"""Cells with their number of seeds."""
FIGURES: dict[str, int] = CASES["release"]["figures"]
"""What is kept of a run, with decimals."""
COMMANDS: dict[str, str] = CASES["release"]["commands"]
"""Commands whose output the documents show, in this order: later ones use what earlier ones wrote."""


def is_release(path: Path) -> bool:
    """Whether a file is the record of a release."""
    return is_record(path, ("version", "commit", "runs", "outputs"))


def release_cells(data: Path | None) -> list[Cell]:
    """Every run of a release.

    Raises:
        EvaluationError: If a recording is missing.
    """
    found = list_cells(data, "all", range(max(RUNS.values())), tuple(RUNS))
    missing = RUNS.keys() - {cell.name for cell in found}
    if missing:
        raise EvaluationError(f"a release needs all of its recordings; missing: {', '.join(sorted(missing))}")
    return [cell for cell in found if cell.seed < RUNS[cell.name]]


def release_record(rows: Sequence[Row], commit: str, outputs: dict[str, list[str]]) -> dict[str, Any]:
    """Medians and ranges of the release's runs with their conditions.

    Raises:
        EvaluationError: If a run has no result, or the code is no commit: such a release would not be reproducible.
    """
    if "+" in commit:
        raise EvaluationError(f"the code has uncommitted changes ({commit}): a release is of a commit")
    failed = [f"{row['cell']} seed {row['seed']}: {row['error']}" for row in rows if row["error"]]
    if failed:
        raise EvaluationError(f"no release: {len(failed)} runs failed, such as {failed[0]}")
    cells: dict[str, dict[str, Any]] = {}
    for name, seeds in RUNS.items():
        own = [row["figures"] for row in rows if row["cell"] == name and row["seed"] < seeds]
        if len(own) < seeds:
            raise EvaluationError(f"no release: {name} has {len(own)} of {seeds} runs")
        cells[name] = {"seeds": seeds}
        for key in FIGURES:
            if known := [f[key] for f in own if f.get(key) is not None]:
                cells[name][key] = [_rounded(middle(known), key) for middle in (np.median, np.min, np.max)]
    everything = [row["figures"] for row in rows]
    return {
        "version": __version__,
        "commit": commit,
        "date": time.strftime("%Y-%m-%d", time.gmtime()),
        "machine": machine() | {"orb_ms": _rounded(np.median([f["orb_ms"] for f in everything]), "orb_ms")},
        "took_minutes": round(sum(f["took_s"] for f in everything) / 60.0),
        "spread": ["median", "lowest", "highest"],
        "runs": cells,
        "outputs": outputs,
    }


def _rounded(value: Any, figure: str) -> float | int:
    return round(float(value), FIGURES[figure] or None)


def command_outputs(data: Path, out: Path, commit: str, say: Callable[[str], None]) -> dict[str, list[str]]:
    """Lines that the documents' commands print; what an earlier call with the same code left in ``out`` is taken.

    Raises:
        EvaluationError: If one fails.
    """
    folder = out / FOLDER
    kept = folder / "outputs.json"
    found = read_mapping(kept, "JSON", EvaluationError) if kept.is_file() else {}
    if found.get("key") != [commit, COMMANDS]:
        shutil.rmtree(folder, ignore_errors=True)
        found = {"key": [commit, COMMANDS], "lines": {}}
    recordings = folder / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    there = {folder.name: folder for folder in data.iterdir() if folder.is_dir()}
    for name, folder_of_data in (there | {name: found for name, (found, _) in find_recordings(data).items()}).items():
        if not (recordings / name).exists():
            (recordings / name).symlink_to(folder_of_data.resolve())
    for name, command in COMMANDS.items():
        if name not in found["lines"]:
            say(f"$ {command}")
            words = [sys.executable, "-m", "edgeslam_torch.cli", *command.split()[1:]]
            environment = os.environ | {"COLUMNS": "100"}
            done = subprocess.run(words, cwd=folder, capture_output=True, text=True, env=environment, check=False)
            if done.returncode != 0:
                raise EvaluationError(f"{command}: {(done.stderr or done.stdout).strip()[-300:]}")
            found["lines"][name] = [f"$ {command}", *(line.rstrip() for line in done.stdout.splitlines())]
            write_text(kept, json.dumps(found, indent=1) + "\n")
    return dict(found["lines"])
