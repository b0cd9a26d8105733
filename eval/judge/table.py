"""The judge's record as a table that is Markdown too, one line a cell and every run below it."""

from collections.abc import Sequence
from typing import Any

from edgeslam_torch.eval.experiment.figures import grouped
from edgeslam_torch.eval.experiment.tables import markdown_table
from edgeslam_torch.eval.judge.score import COLUMNS
from edgeslam_torch.eval.judge.thresholds import Row, Threshold, verdicts

_FOOTNOTES = (
    "end, live: share of the frames whose pose rests on the map, at the end and when they came. path: ATE in % of the "
    "true path. still: ATE of the best fixed position. scale: true over estimated; sigma as the run states it, z = log "
    "scale / sigma. 1st scale s: when the published unit first became the drone's metre, its z; >3 sigma: share of "
    "the frames from 12.5 s on whose live scale is further off. 1st s: error of the first second's poses, and how many "
    "times that of the others it is. Lengths in "
    "metres unless they say otherwise; ATE after Sim(3) over all frames.",
    "Maps of recordings are judged against depth maps nearer than 5 m, those of simulations against the true surfaces. "
    "7scenes_redkitchen's depth maps are not registered to colour by its makers: the transformation was fitted to its "
    "own images (readers/layouts/seven_scenes.py), so that a few mm of its map's distances are that fit's.",
    "CPU is user and system time of the whole process a frame, start-up included and judging left out; in ORB, the "
    "same in passes of ORB over one 640 x 480 image, timed before and after the run. Variants also decode the frames "
    "that they leave out.",
)


def markdown(record: dict[str, Any], thresholds: Sequence[Threshold]) -> str:
    """Medians and thresholds, what passed, footnotes, and every run when there are several a cell."""
    rows = record["rows"]
    cells = grouped(rows, "cell")
    header = ["cell", *(c.title for c in COLUMNS), "thresholds"]
    lines = [[name, *_cells(own), _passed(name, rows, thresholds)] for name, own in cells.items()]
    parts = [_conditions(record), "", markdown_table(header, lines), "", *_outcome(lines, rows, thresholds)]
    notes = [f"- {_run_name(row)}: {note}" for row in rows for note in row["notes"]]
    parts += ["", *notes] if notes else []
    parts += ["", *_FOOTNOTES]
    if len(rows) > len(cells):
        parts += ["", "Every run:", "", markdown_table(header[:-1], [[_run_name(row), *_cells([row])] for row in rows])]
    return "\n".join(parts) + "\n"


def _conditions(record: dict[str, Any]) -> str:
    seeds = len({row["seed"] for row in record["rows"]})
    changed = f", {' '.join(record['overrides'])}" if record["overrides"] else ", default settings"
    frames = f", the first {record['max_frames']} frames" if record["max_frames"] else ""
    return f"EdgeSLAM-Torch {record['commit']}, {record['made']}, {seeds} seed(s){changed}{frames}"


def _passed(name: str, rows: Sequence[Row], thresholds: Sequence[Threshold]) -> str:
    own = [row for row in rows if row["cell"] == name]
    errors = [row["error"] for row in own if row["error"]]
    if errors:
        return f"FAIL {len(errors)} of {len(own)} runs"
    found = verdicts(rows, thresholds, name)
    failed = sum(not v.ok for v in found)
    return (f"FAIL {failed} of {len(found)}" if failed else "pass") if found else "-"


def _outcome(lines: Sequence[Sequence[str]], rows: Sequence[Row], thresholds: Sequence[Threshold]) -> list[str]:
    """How many cells pass, what fails, and the thresholds that only a share of runs must pass."""
    outcomes = [line[-1] for line in lines if line[-1] != "-"]
    out = [f"{outcomes.count('pass')} of {len(outcomes)} cells with thresholds pass."]
    out += [f"- {_run_name(row)}: no result: {row['error']}" for row in rows if row["error"]]
    for name, *_ in lines:
        failed = [str(v) for v in verdicts(rows, thresholds, name) if not v.ok]
        out += [f"- {name}: {'; '.join(failed)}"] if failed else []
    for v in verdicts(rows, thresholds):
        word, cells = "pass" if v.ok else "FAIL", ", ".join(v.threshold.cells)
        out.append(f"- {cells}: {v.threshold} in {v.threshold.share:.0%}: {v.passed} of {v.runs}, {word}")
    return out


def _cells(rows: Sequence[Row]) -> list[str]:
    return [figure.cell(figure.values(rows)) for figure in COLUMNS]


def _run_name(row: Row) -> str:
    return f"{row['cell']} seed {row['seed']}"
