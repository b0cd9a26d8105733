"""The benchmark's figures, their noise, and the comparison of two records.

Accuracy repeats to the byte for a seed and speed does not (on a shared machine a run takes 1.5 times as long minutes
later), so figures have their own kinds of noise:

- accuracy: offline the same seed gives the same bytes, so what differs is the seed. Two medians differ by chance by
  ``2 sqrt(s_a^2/n_a + s_b^2/n_b)``, with ``s`` the sample standard deviation over the seeds;
- times: every run's time is brought to one machine speed by the fixed work that was timed right before and after it
  (`machine_speed.reference`). ``s`` is what still scatters, relative, pooled over the sequences; as a table has some
  fifty times, three sigma instead of two, and 1.25 because medians scatter more than means;
- both: never less than a floor per figure, for what one record cannot see of itself.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.types import FloatArray

FORMAT = 2
"""Of a record; 1 had no reference work, and single values for solver and depth network."""

_SIGMAS = 2.0
_TIMED_SIGMAS = 3.0 * 1.25
_SHORTEST_STAGE_MS = 0.05
"""Mean milliseconds a frame below which a stage is not worth comparing."""

ALONE = "the parts alone"
"""Sequence name of the solver's and the depth network's times."""


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure of a run."""

    name: str
    title: str
    text: str
    lower_is_better: bool
    floor: float
    """Relative difference below which two medians count as equal, whatever their scatter."""
    clock: str = ""
    """Which time of the reference work it follows (`machine_speed.reference`); empty when it is no time."""


METRICS = (
    Metric("ate_sim3_m", "ATE Sim(3) [m]", "{:.4f}", True, 0.03),
    Metric("ate_online_sim3_m", "online [m]", "{:.4f}", True, 0.03),
    Metric("ate_se3_m", "ATE SE(3) [m]", "{:.4f}", True, 0.03),
    Metric("scale_error_abs", "scale off", "{:.1%}", True, 0.05),
    Metric("coverage", "coverage", "{:.1%}", False, 0.005),
    Metric("first_pose_s", "first pose [s]", "{:.2f}", True, 0.05),
    Metric("map_points", "map points", "{:.0f}", False, 0.05),
    Metric("map_median_m", "map error [m]", "{:.4f}", True, 0.03),
    Metric("map_within_6cm", "points in 6 cm", "{:.0%}", False, 0.02),
    Metric("edges_within_2cm", "edges in 2 cm", "{:.0%}", False, 0.03),
    Metric("edges_within_6cm", "edges in 6 cm", "{:.0%}", False, 0.02),
    Metric("cpu_ms_per_frame", "CPU [ms/frame]", "{:.1f}", True, 0.10, "cpu_ms"),
    Metric("fps", "frames/s", "{:.1f}", False, 0.15, "wall_ms"),
    Metric("peak_rss_mb", "memory [MB]", "{:.0f}", True, 0.05),
)

_STAGE_FLOOR, _ALONE_FLOOR = 0.15, 0.10


@dataclass(frozen=True, slots=True)
class _Series:
    """One figure's values in one record."""

    raw: FloatArray
    level: FloatArray
    """The same at the record's median machine speed."""
    scatter: float
    """Relative standard deviation of one value of ``level``."""
    reference_ms: float
    """Median of the reference work in the record; NaN when it has none or the figure is no time."""


def compare(before: dict[str, Any], after: dict[str, Any]) -> list[dict[str, Any]]:
    """Figure by figure: medians, noise and verdict (``better``, ``worse``, ``same``) of two records.

    Rows of times hold the medians as measured, and ``at_speed``: the second at the first one's machine speed, which
    is what is judged.
    """
    rows = []
    for name, metric in _compared(before, after):
        a, b = _series(before, name, metric), _series(after, name, metric)
        if len(a.raw) == 0 or len(b.raw) == 0:
            continue
        first, second = float(np.median(a.level)), float(np.median(b.level))
        at_speed = second * _to_speed(metric, b.reference_ms, a.reference_ms)
        noise = max(_chance(metric, a, b), metric.floor * abs(first))
        change = at_speed - first
        gain = -change if metric.lower_is_better else change
        rows.append(
            {
                "sequence": name,
                "metric": metric.name,
                "title": metric.title,
                "text": metric.text,
                "before": float(np.median(a.raw)),
                "after": float(np.median(b.raw)),
                "at_speed": at_speed,
                "change": change,
                "noise": noise,
                "verdict": "same" if abs(change) <= noise else "better" if gain > 0 else "worse",
            }
        )
    return rows


def noise_of(record: dict[str, Any], name: str, metrics: Sequence[Metric] = METRICS) -> dict[str, list[float]]:
    """Differences that `compare` would not consider significant for a second record like this one."""
    out = {}
    for metric in metrics:
        found = _series(record, name, metric)
        if len(found.raw):
            out[metric.name] = [max(_chance(metric, found, found), metric.floor * abs(float(np.median(found.level))))]
    return out


def medians_of(record: dict[str, Any], name: str, metrics: Sequence[Metric] = METRICS) -> dict[str, list[float]]:
    """Medians as measured."""
    found = {metric.name: _values(record, name, metric)[0] for metric in metrics}
    return {key: [float(np.median(values))] for key, values in found.items() if len(values)}


def sequences_of(record: dict[str, Any]) -> list[str]:
    """Names in the order of the runs."""
    return list(dict.fromkeys(r["sequence"] for r in record["runs"]))


def stage_metrics(record: dict[str, Any], name: str) -> list[Metric]:
    """The stages of a sequence's runs as figures, the longest first."""
    runs = [r["stages"] for r in record["runs"] if r["sequence"] == name and r.get("stages")]
    means = {
        stage: float(np.mean([s.get(stage, 0.0) for s in runs])) for stage in dict.fromkeys(k for s in runs for k in s)
    }
    return [
        Metric(f"stage:{stage}", f"{stage} [ms per frame]", "{:.2f}", True, _STAGE_FLOOR, "wall_ms")
        for stage, mean in sorted(means.items(), key=lambda kv: -kv[1])
        if mean >= _SHORTEST_STAGE_MS
    ]


def alone_metrics(record: dict[str, Any]) -> list[Metric]:
    """Solver and depth network as figures; those that were measured several times."""
    return [
        Metric(f"{part}:{key}", f"{part} {key} [ms]", "{:.1f}", True, _ALONE_FLOOR, "one_ms")
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
    rows = compare(before, after)
    lines = ["| sequence | figure | before | after | change | noise | verdict |", "|---|---|---|---|---|---|---|"]
    for r in rows:
        size = abs(r["before"]) or 1.0
        verdict = "inside the noise" if r["verdict"] == "same" else f"**{r['verdict']}**"
        lines.append(
            f"| {r['sequence']} | {r['title']} | {r['text'].format(r['before'])} | {r['text'].format(r['after'])} | "
            f"{r['change'] / size:+.1%} | ±{r['noise'] / size:.1%} | {verdict} |"
        )
    outside = [f"{r['sequence']} {r['title']} ({r['verdict']})" for r in rows if r["verdict"] != "same"]
    lines += ["", *_machines(before, after), *differences_of_conditions(before, after)]
    inside = len(rows) - len(outside)
    told = f"; outside it: {', '.join(outside)}" if outside else ""
    lines += [f"{inside} of {len(rows)} differences lie inside the noise{told}"]
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


def _machines(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    a, b = reference_of(before, "cpu_ms"), reference_of(after, "cpu_ms")
    if not len(a) or not len(b):
        return ["no reference work in one of the records: times are compared as they are, the machine's speed included"]
    return [
        f"machine: the reference work took {np.median(a):.1f} ms CPU ({a.min():.1f} to {a.max():.1f}), then "
        f"{np.median(b):.1f} ({b.min():.1f} to {b.max():.1f}); changes of times are at the first one's speed"
    ]


def _compared(before: dict[str, Any], after: dict[str, Any]) -> Iterator[tuple[str, Metric]]:
    for name in sequences_of(before):
        if name in sequences_of(after):
            yield from ((name, metric) for metric in (*METRICS, *stage_metrics(before, name)))
    yield from ((ALONE, metric) for metric in alone_metrics(before))


def _values(record: dict[str, Any], name: str, metric: Metric) -> tuple[FloatArray, FloatArray]:
    """Values of a figure, and the reference work [ms] timed beside each (NaN without)."""
    kind, _, key = metric.name.partition(":")
    if kind in ("solver", "depth"):
        values = (record.get(kind) or {}).get(key)
        pairs = zip(values if isinstance(values, list) else (), record.get("references") or (), strict=False)
        found = [(v, r.get(metric.clock)) for v, r in pairs]
    else:
        runs = [r for r in record["runs"] if r["sequence"] == name]
        table, key = ("stages", key) if kind == "stage" else ("figures", metric.name)
        found = [((r.get(table) or {}).get(key), (r.get("reference") or {}).get(metric.clock)) for r in runs]
    known = [(v, np.nan if r is None else r) for v, r in found if v is not None]
    return np.array([v for v, _ in known], dtype=np.float64), np.array([r for _, r in known], dtype=np.float64)


def _series(record: dict[str, Any], name: str, metric: Metric) -> _Series:
    raw, level = _levelled(record, name, metric)
    if not metric.clock:
        scatter = float(np.std(raw, ddof=1) / abs(np.median(raw))) if len(raw) > 1 and np.median(raw) else 0.0
        return _Series(raw, raw, scatter, float("nan"))
    references = reference_of(record, metric.clock)
    middle = float(np.median(references)) if len(references) else float("nan")
    groups = [level] if name == ALONE else [_levelled(record, n, metric)[1] for n in sequences_of(record)]
    return _Series(raw, level, _pooled(groups, references), middle)


def _levelled(record: dict[str, Any], name: str, metric: Metric) -> tuple[FloatArray, FloatArray]:
    raw, beside = _values(record, name, metric)
    references = reference_of(record, metric.clock) if metric.clock else np.zeros(0)
    if not len(references) or not np.isfinite(beside).all():
        return raw, raw
    factor = np.median(references) / beside
    return raw, raw * factor if metric.lower_is_better else raw / factor


def _pooled(groups: Iterable[FloatArray], references: FloatArray) -> float:
    """Relative scatter within groups of values; that of the reference work when no group has two."""
    many = [g / np.mean(g) for g in groups if len(g) > 1 and np.mean(g) > 0]
    freedom = sum(len(g) - 1 for g in many)
    if freedom:
        return float(np.sqrt(sum(float(np.sum((g - 1.0) ** 2)) for g in many) / freedom))
    return float(np.std(references, ddof=1) / np.mean(references)) if len(references) > 1 else 0.0


def _chance(metric: Metric, a: _Series, b: _Series) -> float:
    """Difference of two medians by chance, in the figure's unit."""
    parts = [(s.scatter * abs(float(np.median(s.level)))) ** 2 / len(s.raw) for s in (a, b)]
    return (_TIMED_SIGMAS if metric.clock else _SIGMAS) * float(np.sqrt(sum(parts)))


def _to_speed(metric: Metric, own_ms: float, other_ms: float) -> float:
    """Factor that brings a figure from a machine of one speed to one of another."""
    if not metric.clock or not np.isfinite(own_ms) or not np.isfinite(other_ms):
        return 1.0
    return other_ms / own_ms if metric.lower_is_better else own_ms / other_ms
