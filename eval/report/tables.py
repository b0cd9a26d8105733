"""Scores as tables, aligned text for a terminal or Markdown: every run on its own line."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from edgeslam_torch.eval.experiment.figures import Figure, markdown_table, text_table
from edgeslam_torch.eval.metrics.depth_error import TITLES, DepthReport
from edgeslam_torch.eval.metrics.edge_map_score import THRESHOLDS_M
from edgeslam_torch.eval.metrics.run_score import RunScore
from edgeslam_torch.eval.metrics.trajectory_error import CommonScore

TRAJECTORY_COLUMNS = (
    Figure("ate_sim3_m", "ATE Sim(3) [m]"),
    Figure("ate_se3_m", "ATE SE(3) [m]"),
    Figure("ate_online_sim3_m", "online Sim(3) [m]"),
    Figure("scale_error", "scale - 1", "{:+.1%}"),
    Figure("coverage", "coverage", "{:.1%}"),
    Figure("first_pose_s", "first pose [s]", "{:.2f}"),
    Figure("rotation_deg", "rotation [deg]", "{:.2f}"),
    Figure("rpe_1s_m", "RPE 1 s [m]"),
    Figure("rpe_1s_deg", "RPE 1 s [deg]", "{:.2f}"),
    Figure("full_transform", "full transform (unitless)"),
    Figure("matched", "poses", "{:.0f}"),
)
"""By the name in a `RunScore`."""
TERMINAL_COLUMNS = tuple(c for c in TRAJECTORY_COLUMNS if "unitless" not in c.title)
"""What fits beside one another; the paper's unitless figure is in the details."""
MAP_COLUMNS = (
    Figure("points", "points", "{:.0f}"),
    Figure("judged_share", "judged", "{:.0%}"),
    Figure("median_m", "median [m]"),
    Figure("single_map_median_m", "one-map median [m]"),
    Figure("own_alignment_median_m", "own alignment [m]"),
    *(Figure(f"accuracy {t}", f"accuracy {100 * t:.0f} cm", "{:.0%}") for t in THRESHOLDS_M),
    *(Figure(f"completeness {t}", f"edges {100 * t:.0f} cm", "{:.0%}") for t in THRESHOLDS_M),
    *(Figure(f"f_score {t}", f"F {100 * t:.0f} cm", "{:.2f}") for t in THRESHOLDS_M),
)
"""By the name in a `MapScore`, with the threshold."""


def _value(score: RunScore, column: Figure) -> float:
    """NaN where there is none."""
    name, _, threshold = column.name.partition(" ")
    found = getattr(score, name, None) if column in TRAJECTORY_COLUMNS else getattr(score.map, name, None)
    found = found.get(float(threshold)) if threshold and found is not None else found
    return float("nan") if found is None else float(found)


def report(scores: Sequence[RunScore], markdown: bool = False) -> str:
    """Trajectory table, map table and findings."""
    table = markdown_table if markdown else text_table
    parts = [f"Ground truth: {', '.join(sorted({s.dataset for s in scores}))}", ""]
    parts += [table(*_cells(scores, TRAJECTORY_COLUMNS if markdown else TERMINAL_COLUMNS))]
    if any(s.map is not None for s in scores):
        parts += ["", "Edge map against measured depth, aligned by the trajectory's Sim(3):", ""]
        parts += [table(*_cells([s for s in scores if s.map is not None], MAP_COLUMNS))]
    parts += [""] + [f"- {s.name}: {note}" for s in scores for note in _notes(s)]
    return "\n".join(parts).rstrip() + "\n"


def report_of_two(first: RunScore, second: RunScore) -> str:
    """Every figure of two runs, and the second's minus the first's."""
    rows = []
    for column in (*TRAJECTORY_COLUMNS, *MAP_COLUMNS):
        a, b = (_value(score, column) for score in (first, second))
        signed = replace(column, text=column.text.replace("{:+", "{:").replace("{:", "{:+"))
        if np.isfinite(a) or np.isfinite(b):
            rows.append([column.title, column.cell([a]), column.cell([b]), signed.cell([b - a])])
    lines = [f"A: {first.name}", f"B: {second.name}", f"Ground truth: {first.dataset}", ""]
    lines += [text_table(["", "A", "B", "B - A"], rows), ""]
    lines += [f"- {letter}: {note}" for letter, s in zip("AB", (first, second), strict=True) for note in _notes(s)]
    return "\n".join(lines).rstrip() + "\n"


def depth_report(report: DepthReport) -> str:
    """Figures of depth maps."""
    names = ("abs_rel", "rmse_m", "log_rmse", "delta1", "delta2", "delta3", "scale")
    rows = [[TITLES[k], *(f"{getattr(score, name):.4f}" for name in names)] for k, score in report.items()]
    return markdown_table(["pixels", "AbsRel", "RMSE [m]", "log RMSE", "delta1", "delta2", "delta3", "scale"], rows)


def common_report(scores: Sequence[CommonScore], markdown: bool = False) -> str:
    """Errors of several trajectories on their common frames."""
    titles = ["run", "own poses", "ATE Sim(3) [m]", "ATE SE(3) [m]", "max [m]", "rotation [deg]", "scale - 1"]
    rows = []
    for s in scores:
        degrees = f"{s.sim3.rotation_deg.rmse:.2f}" if np.isfinite(s.sim3.rotation_deg.rmse) else "-"
        metres = (f"{m:.4f}" for m in (s.sim3.ate_m.rmse, s.se3.ate_m.rmse, s.sim3.ate_m.max))
        rows.append([s.name, str(s.frames), *metres, degrees, f"{s.sim3.scale - 1:+.1%}"])
    count = f"{scores[0].sim3.matched} frames that all {len(scores)} have"
    head = f"On the {count} (with ground truth), each aligned by itself:"
    return f"{head}\n\n" + (markdown_table if markdown else text_table)(titles, rows)


def _cells(scores: Sequence[RunScore], columns: Sequence[Figure]) -> tuple[list[str], list[list[str]]]:
    """Titles and rows, without the columns that no run has."""
    used = [c for c in columns if any(np.isfinite(_value(s, c)) for s in scores)]
    return ["run", *(c.title for c in used)], [[s.name, *(c.cell([_value(s, c)]) for c in used)] for s in scores]


def _notes(score: RunScore) -> list[str]:
    notes = list(score.notes)
    if score.units == "arbitrary":
        notes.append("the run's units are arbitrary (no metric scale): only the Sim(3) figures mean anything")
    named = any(" times the " in note for note in notes)
    if score.units == "unknown" and abs(score.scale_error) > 0.2 and not named:
        notes.append("not of the truth's size: if it is monocular, only the Sim(3) figures mean anything")
    if score.scale_inside_95 is not None:
        inside = "inside" if score.scale_inside_95 else "OUTSIDE"
        notes.append(f"the true scale is {inside} the run's own 95 % interval")
    return notes
