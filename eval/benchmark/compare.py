"""The benchmark's figures, their noise, and the comparison of two records.

Accuracy repeats to the byte for a seed and speed does not (on a shared machine a run takes 1.5 times as long minutes
later). So every run's time is brought to one machine speed by the fixed work that was timed right before and after it
(`machine_speed.reference`), and what still scatters is pooled, relative, over the sequences. As a table has some fifty
times, they take three sigma instead of two, and 1.25 because medians scatter more than means.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.figures import SIGMAS, Figure, chance, difference, scatter
from edgeslam_torch.eval.report.tables import markdown_table
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.types import FloatArray

FORMAT = 2
"""Of a record; 1 had no reference work, and single values for solver and depth network."""
_TIMED_SIGMAS = 3.0 * 1.25
_SHORTEST_STAGE_MS = 0.05
"""Mean milliseconds a frame below which a stage is not worth comparing."""
_STAGE_FLOOR, _ALONE_FLOOR = 0.15, 0.10
ALONE = "the parts alone"
"""Sequence name of the solver's and the depth network's times."""

METRICS = (
    Figure("ate_sim3_m", "ATE Sim(3) [m]", floor=0.03),
    Figure("ate_online_sim3_m", "online [m]", floor=0.03),
    Figure("ate_se3_m", "ATE SE(3) [m]", floor=0.03),
    Figure("scale_error_abs", "scale off", "{:.1%}", floor=0.05),
    Figure("coverage", "coverage", "{:.1%}", floor=0.005, lower_is_better=False),
    Figure("first_pose_s", "first pose [s]", "{:.2f}", floor=0.05),
    Figure("map_points", "map points", "{:.0f}", floor=0.05, lower_is_better=False),
    Figure("map_median_m", "map error [m]", floor=0.03),
    Figure("map_within_6cm", "points in 6 cm", "{:.0%}", floor=0.02, lower_is_better=False),
    Figure("edges_within_2cm", "edges in 2 cm", "{:.0%}", floor=0.03, lower_is_better=False),
    Figure("edges_within_6cm", "edges in 6 cm", "{:.0%}", floor=0.02, lower_is_better=False),
    Figure("cpu_ms_per_frame", "CPU [ms/frame]", "{:.1f}", floor=0.10, clock="cpu_ms"),
    Figure("fps", "frames/s", "{:.1f}", floor=0.15, lower_is_better=False, clock="wall_ms"),
    Figure("peak_rss_mb", "memory [MB]", "{:.0f}", floor=0.05),
)


def compare(before: dict[str, Any], after: dict[str, Any]) -> list[dict[str, Any]]:
    """Figure by figure: medians, noise and verdict (``better``, ``worse``, ``same``) of two records.

    Rows of times hold the medians as measured, and ``at_speed``: the second at the first one's machine speed, which
    is what is judged.
    """
    rows = []
    for name, metric in _compared(before, after):
        (raw_a, a), (raw_b, b) = (_levelled(record, name, metric) for record in (before, after))
        if len(a) == 0 or len(b) == 0:
            continue
        b = b * _to_speed(metric, after, before)
        by_chance = _chance(metric, (a, b), [_scatter(r, name, metric, v) for r, v in ((before, a), (after, b))])
        found = difference(metric, a.tolist(), b.tolist(), by_chance)
        rows.append(
            {
                "sequence": name,
                "metric": metric.name,
                "title": metric.title,
                "text": metric.text,
                "before": float(np.median(raw_a)),
                "after": float(np.median(raw_b)),
                "at_speed": found.after,
                "change": found.after - found.before,
                "noise": found.noise,
                "verdict": found.verdict,
            }
        )
    return rows


def noise_of(record: dict[str, Any], name: str, metrics: Sequence[Figure] = METRICS) -> dict[str, float]:
    """Differences that `compare` would not consider significant for a second record like this one."""
    out = {}
    for metric in metrics:
        _, values = _levelled(record, name, metric)
        if len(values):
            by_chance = _chance(metric, (values, values), [_scatter(record, name, metric, values)] * 2)
            out[metric.name] = difference(metric, values.tolist(), values.tolist(), by_chance).noise
    return out


def medians_of(record: dict[str, Any], name: str, metrics: Sequence[Figure] = METRICS) -> dict[str, float]:
    """Medians as measured."""
    found = {metric.name: _levelled(record, name, metric)[0] for metric in metrics}
    return {key: float(np.median(values)) for key, values in found.items() if len(values)}


def sequences_of(record: dict[str, Any]) -> list[str]:
    """Names in the order of the runs."""
    return list(dict.fromkeys(r["sequence"] for r in record["runs"]))


def stage_metrics(record: dict[str, Any], name: str) -> list[Figure]:
    """The stages of a sequence's runs as figures, the longest first."""
    runs = [r["stages"] for r in record["runs"] if r["sequence"] == name and r.get("stages")]
    means = {
        stage: float(np.mean([s.get(stage, 0.0) for s in runs])) for stage in dict.fromkeys(k for s in runs for k in s)
    }
    return [
        Figure(f"stage:{stage}", f"{stage} [ms per frame]", "{:.2f}", floor=_STAGE_FLOOR, clock="wall_ms")
        for stage, mean in sorted(means.items(), key=lambda kv: -kv[1])
        if mean >= _SHORTEST_STAGE_MS
    ]


def alone_metrics(record: dict[str, Any]) -> list[Figure]:
    """Solver and depth network as figures; those that were measured several times."""
    return [
        Figure(f"{part}:{key}", f"{part} {key} [ms]", "{:.1f}", floor=_ALONE_FLOOR, clock="one_ms")
        for part in ("solver", "depth")
        for key, values in (record.get(part) or {}).items()
        if isinstance(values, list) and values and all(isinstance(v, (int, float)) and np.isfinite(v) for v in values)
    ]


def read_record(path: Path) -> dict[str, Any]:
    """A record that `run_benchmark` wrote.

    Raises:
        EvaluationError: If the file is missing or no such record.
    """
    record = read_mapping(path, "JSON", EvaluationError)
    if record.get("format") not in (1, FORMAT) or "runs" not in record:
        raise EvaluationError(f"{path}: not a result of 'edgeslam bench' (format {FORMAT})")
    return record


def markdown_compare(before: dict[str, Any], after: dict[str, Any]) -> str:
    """The comparison as a table, what to beware of, and how many differences lie inside the noise."""
    rows, cells = compare(before, after), []
    for r in rows:
        size = abs(r["before"]) or 1.0
        verdict = "inside the noise" if r["verdict"] == "same" else f"**{r['verdict']}**"
        values = [r["text"].format(r["before"]), r["text"].format(r["after"])]
        cells.append(
            [r["sequence"], r["title"], *values, f"{r['change'] / size:+.1%}", f"±{r['noise'] / size:.1%}", verdict]
        )
    lines = [markdown_table(("sequence", "figure", "before", "after", "change", "noise", "verdict"), cells), ""]
    outside = [f"{r['sequence']} {r['title']} ({r['verdict']})" for r in rows if r["verdict"] != "same"]
    lines += [_machines(before, after), *differences_of_conditions(before, after)]
    told = f"; outside it: {', '.join(outside)}" if outside else ""
    lines += [f"{len(rows) - len(outside)} of {len(rows)} differences lie inside the noise{told}"]
    return "\n".join(lines) + "\n"


def differences_of_conditions(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Differences of conditions, one line each."""
    lines = []
    for key in ("machine", "seeds", "mode", "max_frames", "overrides"):
        a, b = before.get(key), after.get(key)
        if isinstance(a, dict) and isinstance(b, dict):
            lines += [f"beware: {k} was {a.get(k)}, then {b.get(k)}" for k in a if a.get(k) != b.get(k)]
        elif a != b:
            lines.append(f"beware: {key} was {a}, then {b}")
    for which, record in (("first", before), ("second", after)):
        if busy := busy_runs(record):
            lines.append(f"beware: in the {which} record {busy}")
    return lines


def busy_runs(record: dict[str, Any]) -> str:
    """Warning about runs under other load; empty without any, or if unknown."""
    looked = [r["disturbance"] for r in record["runs"] if r.get("disturbance")]
    busy = [d for d in looked if d["busy"]]
    if not busy:
        return ""
    most, stolen = max(d["others"] for d in busy), max(d["stolen"] for d in busy)
    return (
        f"the machine was busy during {len(busy)} of {len(looked)} runs: other programs used up to {most:.0%} of it, "
        f"its host took up to {stolen:.0%}; their times are unreliable"
    )


def reference_of(record: dict[str, Any], clock: str) -> FloatArray:
    """Milliseconds of the reference work all through a record; empty when it has none."""
    return np.array([r[clock] for r in record.get("references") or () if clock in r], dtype=np.float64)


def _machines(before: dict[str, Any], after: dict[str, Any]) -> str:
    a, b = reference_of(before, "cpu_ms"), reference_of(after, "cpu_ms")
    if not len(a) or not len(b):
        return "no reference work in one of the records: times are compared as they are, the machine's speed included"
    return (
        f"machine: the reference work took {np.median(a):.1f} ms CPU ({a.min():.1f} to {a.max():.1f}), then "
        f"{np.median(b):.1f} ({b.min():.1f} to {b.max():.1f}); changes of times are at the first one's speed"
    )


def _compared(before: dict[str, Any], after: dict[str, Any]) -> Iterator[tuple[str, Figure]]:
    for name in sequences_of(before):
        if name in sequences_of(after):
            yield from ((name, metric) for metric in (*METRICS, *stage_metrics(before, name)))
    yield from ((ALONE, metric) for metric in alone_metrics(before))


def _levelled(record: dict[str, Any], name: str, metric: Figure) -> tuple[FloatArray, FloatArray]:
    """Values of a figure as measured, and at the record's median machine speed."""
    kind, _, key = metric.name.partition(":")
    if kind in ("solver", "depth"):
        values = (record.get(kind) or {}).get(key)
        pairs = zip(values if isinstance(values, list) else (), record.get("references") or (), strict=False)
        found = [(v, r.get(metric.clock)) for v, r in pairs]
    else:
        runs = [r for r in record["runs"] if r["sequence"] == name]
        table, key = ("stages", key) if kind == "stage" else ("figures", metric.name)
        found = [((r.get(table) or {}).get(key), (r.get("reference") or {}).get(metric.clock)) for r in runs]
    raw = np.array([v for v, _ in found if v is not None], dtype=np.float64)
    beside = np.array([np.nan if r is None else r for v, r in found if v is not None], dtype=np.float64)
    references = reference_of(record, metric.clock)
    if not len(references) or not np.isfinite(beside).all():
        return raw, raw
    factor = np.median(references) / beside
    return raw, raw * factor if metric.lower_is_better else raw / factor


def _scatter(record: dict[str, Any], name: str, metric: Figure, values: FloatArray) -> float:
    """Standard deviation of levelled values; of times the pooled relative one of all sequences."""
    if not metric.clock:
        return scatter(values.tolist())
    names = [name] if name == ALONE else sequences_of(record)
    groups = [_levelled(record, n, metric)[1] for n in names]
    many = [g / np.mean(g) for g in groups if len(g) > 1 and np.mean(g) > 0]
    references = reference_of(record, metric.clock)
    if many:
        squares = sum(float(np.sum((g - 1.0) ** 2)) for g in many)
        relative = np.sqrt(squares / sum(len(g) - 1 for g in many))
    else:
        relative = np.std(references, ddof=1) / np.mean(references) if len(references) > 1 else 0.0
    return float(relative) * abs(float(np.median(values)))


def _chance(metric: Figure, sides: Sequence[FloatArray], scatters: Sequence[float]) -> float:
    return chance([side.tolist() for side in sides], scatters, _TIMED_SIGMAS if metric.clock else SIGMAS)


def _to_speed(metric: Figure, own: dict[str, Any], other: dict[str, Any]) -> float:
    """Factor that brings a figure from a record's machine speed to another's."""
    own_ms, other_ms = (reference_of(record, metric.clock) for record in (own, other))
    if not len(own_ms) or not len(other_ms):
        return 1.0
    factor = float(np.median(other_ms) / np.median(own_ms))
    return factor if metric.lower_is_better else 1.0 / factor
