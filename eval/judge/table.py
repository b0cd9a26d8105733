"""The judge's record as an aligned table that is Markdown too, one line a cell, and every run below it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from edgeslam_torch.eval.judge.thresholds import Row, Threshold, verdicts_of_cell, verdicts_of_groups

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


@dataclass(frozen=True, slots=True)
class Column:
    """One column of the table."""

    title: str
    figure: str
    text: str = "{:.4f}"
    factor: float = 1.0
    spread: bool = False
    """With several seeds, give the lowest and highest too."""

    def cell(self, values: Sequence[float | None]) -> str:
        """Median of the runs' values; a dash when there is none."""
        known = self.factor * np.array([v for v in values if v is not None])
        if len(known) == 0:
            return "-"
        text = self.text.format(float(np.median(known)))
        if self.spread and len(known) > 1:
            text += f" [{self.text.format(known.min())} {self.text.format(known.max())}]"
        return text


COLUMNS = (
    Column("frames", "frames", "{:.0f}"),
    Column("end %", "supported_end", "{:.1f}", 100.0),
    Column("live %", "supported_live", "{:.1f}", 100.0),
    Column("lost", "losses", "{:.0f}"),
    Column("pieces", "pieces", "{:.0f}"),
    Column("ATE", "ate_m", spread=True),
    Column("online", "online_m", spread=True),
    Column("path %", "ate_percent", "{:.2f}"),
    Column("return %", "return_percent", "{:.2f}"),
    Column("rot °", "rotation_deg", "{:.2f}"),
    Column("scale", "scale", "{:.3f}"),
    Column("sigma %", "scale_sigma", "{:.1f}", 100.0),
    Column("z", "scale_z", "{:+.1f}"),
    Column("1st scale s", "first_scale_s", "{:.1f}"),
    Column("its z", "first_scale_sigmas", "{:.1f}"),
    Column(">3 sigma %", "beyond_3_sigma", "{:.0f}", 100.0),
    Column("SE(3)", "se3_m"),
    Column("still", "still_m", "{:.3f}"),
    Column("1st s", "first_m"),
    Column("x rest", "first_over_rest", "{:.1f}"),
    Column("points", "map_points", "{:.0f}"),
    Column("median cm", "map_median_m", "{:.2f}", 100.0),
    Column("5 cm %", "map_within_5cm", "{:.0f}", 100.0),
    Column("10 cm %", "map_within_10cm", "{:.0f}", 100.0),
    Column("CPU ms", "cpu_ms", "{:.1f}"),
    Column("CPU ORB", "cpu_orb", "{:.1f}"),
    Column("wall s", "wall_s", "{:.1f}"),
    Column("MB", "memory_mb", "{:.0f}"),
)


def markdown(record: dict[str, Any], thresholds: Sequence[Threshold]) -> str:
    """Medians and thresholds, what passed, footnotes, and every run when there are several a cell."""
    rows = record["rows"]
    names = list(dict.fromkeys(row["cell"] for row in rows))
    parts = [_conditions(record), "", aligned(_header(), [_line(name, rows, thresholds) for name in names])]
    parts += ["", *_outcome(names, rows, thresholds)]
    notes = [f"- {_run_name(row)}: {note}" for row in rows for note in row["notes"]]
    parts += ["", *notes] if notes else []
    parts += ["", *_FOOTNOTES]
    if len(rows) > len(names):
        parts += ["", "Every run:", "", aligned(_header()[:-1], [_run_line(row) for row in rows])]
    return "\n".join(parts) + "\n"


def aligned(header: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A Markdown table whose columns are padded to one width, numbers to the right."""
    widths = [max(3, *(len(line[k]) for line in (header, *lines))) for k in range(len(header))]

    def text(line: Sequence[str]) -> str:
        cells = [c.ljust(w) if k in (0, len(header) - 1) else c.rjust(w)
                 for k, (c, w) in enumerate(zip(line, widths, strict=True))]  # fmt: skip
        return "| " + " | ".join(cells) + " |"

    rule = (
        "|" + "|".join("-" * (w + 1) + ("-" if k in (0, len(header) - 1) else ":") for k, w in enumerate(widths)) + "|"
    )
    return "\n".join([text(header), rule, *(text(line) for line in lines)])


def _conditions(record: dict[str, Any]) -> str:
    seeds = len({row["seed"] for row in record["rows"]})
    changed = f", {' '.join(record['overrides'])}" if record["overrides"] else ", default settings"
    frames = f", the first {record['max_frames']} frames" if record["max_frames"] else ""
    return f"EdgeSLAM-Torch {record['commit']}, {record['made']}, {seeds} seed(s){changed}{frames}"


def _header() -> list[str]:
    return ["cell", *(c.title for c in COLUMNS), "thresholds"]


def _line(name: str, rows: Sequence[Row], thresholds: Sequence[Threshold]) -> list[str]:
    own = [row for row in rows if row["cell"] == name]
    cells = [c.cell([row["figures"].get(c.figure) for row in own]) for c in COLUMNS]
    return [name, *cells, _thresholds_cell(name, own, rows, thresholds)]


def _thresholds_cell(name: str, own: Sequence[Row], rows: Sequence[Row], thresholds: Sequence[Threshold]) -> str:
    errors = [row["error"] for row in own if row["error"]]
    if errors:
        return f"FAIL {len(errors)} of {len(own)} runs"
    verdicts = verdicts_of_cell(name, rows, thresholds)
    if not verdicts:
        return "-"
    passed = sum(v.ok for v in verdicts)
    return "pass" if passed == len(verdicts) else f"FAIL {len(verdicts) - passed} of {len(verdicts)}"


def _outcome(names: Sequence[str], rows: Sequence[Row], thresholds: Sequence[Threshold]) -> list[str]:
    """How many cells pass, what fails, and the thresholds that only a share of runs must pass."""
    judged = [_thresholds_cell(name, [r for r in rows if r["cell"] == name], rows, thresholds) for name in names]
    with_thresholds = [text for text in judged if text != "-"]
    lines = [f"{sum(text == 'pass' for text in with_thresholds)} of {len(with_thresholds)} cells with thresholds pass."]
    lines += [f"- {_run_name(row)}: no result: {row['error']}" for row in rows if row["error"]]
    for name in names:
        failed = [str(v) for v in verdicts_of_cell(name, rows, thresholds) if not v.ok]
        lines += [f"- {name}: {'; '.join(failed)}"] if failed else []
    for v in verdicts_of_groups(rows, thresholds):
        word = "pass" if v.ok else "FAIL"
        cells = ", ".join(v.threshold.cells)
        lines.append(f"- {cells}: {v.threshold} in {v.threshold.share:.0%}: {v.passed} of {v.runs}, {word}")
    return lines


def _run_line(row: Row) -> list[str]:
    return [_run_name(row), *(c.cell([row["figures"].get(c.figure)]) for c in COLUMNS)]


def _run_name(row: Row) -> str:
    return f"{row['cell']} seed {row['seed']}"
