"""Scores as Markdown: every run on its own line, the median under them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.eval.metrics.edge_map_score import THRESHOLDS_M
from edgeslam_torch.eval.metrics.run_score import RunScore


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table."""

    title: str
    value: Callable[[RunScore], float]
    text: str = "{:.4f}"

    def cell(self, value: float) -> str:
        """The value as text, a dash when there is none."""
        return self.text.format(value) if np.isfinite(value) else "-"


def _map(name: str, threshold: float | None = None) -> Callable[[RunScore], float]:
    def value(score: RunScore) -> float:
        if score.map is None:
            return float("nan")
        found = getattr(score.map, name)
        return float(found if threshold is None else found.get(threshold, float("nan")))

    return value


TRAJECTORY_COLUMNS = (
    Column("ATE Sim(3) [m]", lambda s: s.ate_sim3_m),
    Column("ATE SE(3) [m]", lambda s: s.ate_se3_m),
    Column("online Sim(3) [m]", lambda s: s.ate_online_sim3_m),
    Column("scale - 1", lambda s: s.scale_error, "{:+.1%}"),
    Column("coverage", lambda s: s.coverage, "{:.1%}"),
    Column("first pose [s]", lambda s: s.first_pose_s, "{:.2f}"),
    Column("rotation [deg]", lambda s: s.rotation_deg, "{:.2f}"),
    Column("RPE 1 s [m]", lambda s: s.rpe_1s_m),
    Column("RPE 1 s [deg]", lambda s: s.rpe_1s_deg, "{:.2f}"),
    Column("full transform (unitless)", lambda s: s.full_transform),
    Column("poses", lambda s: s.matched, "{:.0f}"),
)

MAP_COLUMNS = (
    Column("points", _map("points"), "{:.0f}"),
    Column("judged", _map("judged_share"), "{:.0%}"),
    Column("median [m]", _map("median_m")),
    Column("one-map median [m]", _map("single_map_median_m")),
    Column("own alignment [m]", _map("own_alignment_median_m")),
    *(Column(f"accuracy {100 * t:.0f} cm", _map("accuracy", t), "{:.0%}") for t in THRESHOLDS_M),
    *(Column(f"edges {100 * t:.0f} cm", _map("completeness", t), "{:.0%}") for t in THRESHOLDS_M),
    *(Column(f"F {100 * t:.0f} cm", _map("f_score", t), "{:.2f}") for t in THRESHOLDS_M),
)


def markdown_table(scores: Sequence[RunScore], columns: Sequence[Column], title: str = "run") -> str:
    """Table of every run; with several runs also their median."""
    used = [c for c in columns if any(np.isfinite(c.value(s)) for s in scores)]
    lines = ["| " + " | ".join([title, *(c.title for c in used)]) + " |", "|" + "---|" * (len(used) + 1)]
    for score in scores:
        lines.append("| " + " | ".join([score.name, *(c.cell(c.value(score)) for c in used)]) + " |")
    if len(scores) > 1:
        medians = [c.cell(_median([c.value(s) for s in scores])) for c in used]
        lines.append("| " + " | ".join([f"**median of {len(scores)}**", *medians]) + " |")
    return "\n".join(lines)


def markdown_report(scores: Sequence[RunScore]) -> str:
    """Trajectory table, map table and findings."""
    parts = [f"Ground truth: {', '.join(sorted({s.dataset for s in scores}))}", ""]
    parts += [markdown_table(scores, TRAJECTORY_COLUMNS)]
    if any(s.map is not None for s in scores):
        parts += ["", "Edge map against measured depth, aligned by the trajectory's Sim(3):", ""]
        parts += [markdown_table([s for s in scores if s.map is not None], MAP_COLUMNS)]
    parts += [""] + [f"- {s.name}: {note}" for s in scores for note in _notes(s)]
    return "\n".join(parts).rstrip() + "\n"


def _notes(score: RunScore) -> list[str]:
    notes = list(score.notes)
    if score.units == "arbitrary":
        notes.append("the run's units are arbitrary (no metric scale): only the Sim(3) figures mean anything")
    if score.units == "unknown" and np.isfinite(score.scale_error) and abs(score.scale_error) > 0.2:
        notes.append("not of the truth's size: if it is monocular, only the Sim(3) figures mean anything")
    if score.scale_inside_95 is not None:
        inside = "inside" if score.scale_inside_95 else "OUTSIDE"
        notes.append(f"the true scale is {inside} the run's own 95 % interval")
    return notes


def _median(values: Sequence[float]) -> float:
    finite = [v for v in values if np.isfinite(v)]
    return float(np.median(finite)) if finite else float("nan")
