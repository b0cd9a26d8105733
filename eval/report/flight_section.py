"""The flight in a run's page: way, clearance, and what happened, from the ``moments.csv`` of a flight by the map."""

import csv
import io
from pathlib import Path

import numpy as np

from edgeslam_torch.eval.inputs.run_folder import number
from edgeslam_torch.eval.metrics.align import travelled
from edgeslam_torch.eval.report.line_drawings import chart, table, view
from edgeslam_torch.files.plain import open_plain

_MOMENTS = "moments.csv"
_EXITS = "exits.csv"
_NEEDED = ("stamp_s", "x_m", "y_m", "phase", "danger", "why")
_EXIT_NEEDED = ("x_m", "y_m", "normal_x", "normal_y", "width_m")
_MOST_EVENTS = 60
_WAY, _CLEARANCE, _EXIT = "var(--tracked)", "var(--predicted)", "var(--lost)"


def flight_section(folder: Path | None) -> str:
    """HTML of the flight that a recording holds; empty when it holds none, or one that cannot be read."""
    rows = [] if folder is None else _rows(folder / _MOMENTS)
    if folder is None or not rows:
        return ""
    columns = {
        name: np.array([number(row.get(name)) for row in rows]) for name in ("stamp_s", "x_m", "y_m", "clearance_m")
    }
    good = np.isfinite(columns["stamp_s"]) & np.isfinite(columns["x_m"]) & np.isfinite(columns["y_m"])
    if good.sum() < 2:
        return ""
    rows = [row for row, ok in zip(rows, good, strict=True) if ok]
    stamps, x, y, clearance = (columns[name][good] for name in ("stamp_s", "x_m", "y_m", "clearance_m"))
    seconds, way = stamps - stamps[0], np.stack([x, y], axis=1)
    exits = [line for row in _rows(folder / _EXITS, _EXIT_NEEDED) if (line := _across(row)) is not None]
    drawing = view([way, *exits], [_WAY, *[_EXIT] * len(exits)], "m")
    parts = ["<h2>Flight</h2>", f'<p class="note">{_words(seconds, way, clearance)}{_exit_words(exits)}</p>', drawing]
    known = np.isfinite(clearance)
    if known.sum() >= 2:
        label = "metres between the hull and the nearest solid on its own map"
        shown = np.clip(clearance[known], 0.0, None)
        parts.append(f'<div class="scroll">{chart(seconds[known], shown, _CLEARANCE, label)}</div>')
    parts.append(_events(rows, seconds))
    return f'<section class="wrap" id="s-flight">{"".join(parts)}</section>'


def _rows(path: Path, needed: tuple[str, ...] = _NEEDED) -> list[dict[str, str]]:
    try:
        with open_plain(path) as file:
            rows = list(csv.DictReader(io.TextIOWrapper(file, "utf-8", newline="")))
    except (OSError, UnicodeDecodeError, csv.Error):
        return []
    return rows if rows and all(name in rows[0] for name in needed) else []


def _across(row: dict[str, str]) -> np.ndarray | None:
    """The opening as a line ``(2, 2)`` from jamb to jamb; None if its numbers are none."""
    x, y, nx, ny, width = (number(row.get(name)) for name in _EXIT_NEEDED)
    ends = np.array([[x, y], [x, y]]) + 0.5 * width * np.array([[-ny, nx], [ny, -nx]])
    return ends if np.isfinite(ends).all() else None


def _exit_words(exits: list[np.ndarray]) -> str:
    if not exits:
        return ""
    widths = ", ".join(f"{np.linalg.norm(line[1] - line[0]):.1f} m" for line in exits)
    return f" {len(exits)} exit{'s' if len(exits) > 1 else ''} found (red), {widths} wide."


def _words(seconds: np.ndarray, way: np.ndarray, clearance: np.ndarray) -> str:
    text = f"{seconds[-1]:.0f} s, {travelled(way)[-1]:.1f} m by its own map, from the dot on"
    if np.isfinite(clearance).any():
        text += f"; never nearer to anything solid on that map than {np.nanmin(clearance):.2f} m"
    return text + "."


def _events(rows: list[dict[str, str]], seconds: np.ndarray) -> str:
    """A row for each change of what it did, or of what kept it from it."""
    out, before = [], None
    for row, t in zip(rows, seconds, strict=True):
        state = (row["phase"], row["danger"])
        if state != before:
            place = f"({number(row['x_m']):.1f}, {number(row['y_m']):.1f})"
            out.append([f"{t:.1f}", place, *(row[name] or "" for name in ("phase", "danger", "why"))])
        before = state
    left = f'<p class="note">and {len(out) - _MOST_EVENTS} more</p>' if len(out) > _MOST_EVENTS else ""
    return table(["s", "at [m]", "doing", "kept from it by", "order"], out[:_MOST_EVENTS]) + left
