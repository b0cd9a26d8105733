"""The cell of two flights: the first saves its map, the second flies in it and is judged.

What counts is whether the place is recognised at once, and whether a metre is as long as the day before.
"""

import math
from pathlib import Path
from typing import Any

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.judge.score import Figures, Truth, score
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.readers.source import Recording
from edgeslam_torch.run import AtlasFiles, RunResult, run, settle_camera

FIRST = "first"
"""Folder of the first flight's run."""
ATLAS = "first.atlas"
NEVER_S = 1e3
"""Stands for a place that is never recognised."""


def fly_first(source: Recording, folder: Path, config: SlamConfig) -> RunResult:
    """Fly and save the map in ``folder``."""
    settle_camera(source)
    return run(source, folder / FIRST, config, atlas=AtlasFiles(save=folder / ATLAS))


def fly_second(source: Recording, out: Path, folder: Path, config: SlamConfig) -> RunResult:
    """Fly in the map of the first flight."""
    from edgeslam_torch.atlas.atlas_file import read_atlas

    settle_camera(source)
    return run(source, out, config, atlas=AtlasFiles(load=read_atlas(folder / ATLAS)))


def compared(second: Path, truth: Truth, first: Path, first_truth: Truth) -> Figures:
    """Figures of the second flight beside those of any run.

    Args:
        second: Its run.
        truth: What it is compared with.
        first: Run of the first flight.
        first_truth: The same of that one.

    Returns:
        ``placed_after_s`` until the first frame in the map of the first flight, ``placed`` share of frames in it,
        ``metres_off`` absolute log of the ratio of the true lengths of the two flights' units.
    """
    summary: dict[str, Any] = read_mapping(second / "summary.json", "JSON", EvaluationError)
    found = summary["atlas"]
    after = found["found_after_s"]
    scales = [score(run, its)[0].get("scale_sim3") for run, its in ((first, first_truth), (second, truth))]
    known = [s for s in scales if s]
    return {
        "placed_after_s": NEVER_S if after is None else after,
        "placed": found["frames_placed"] / max(summary["frames"], 1),
        "metres_off": abs(math.log(known[1] / known[0])) if len(known) == 2 else None,
    }
