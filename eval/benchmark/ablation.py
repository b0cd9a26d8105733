"""Ablation: the same recordings with one change at a time.

Most changes affect only the last refinement. Rows that differ only there share one run: the map before that
refinement is copied and refined once per row.
"""

import io
import json
import logging
import pickle
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch import __version__
from edgeslam_torch.config import SlamConfig, WindowConfig
from edgeslam_torch.eval.benchmark.benchmark import find_sequences
from edgeslam_torch.eval.benchmark.compare import compare
from edgeslam_torch.eval.benchmark.conditions import machine
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.dataset import EvalDataset, interpolate, open_dataset
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.align import AlignmentKind, umeyama
from edgeslam_torch.eval.metrics.edge_map_score import score_map
from edgeslam_torch.eval.metrics.surface import surface_truth
from edgeslam_torch.eval.metrics.trajectory_error import score_trajectory
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.config_file import load_config
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping import prior_anchors
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.last_refinement import last_refinement
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.slam import EdgeSlam

logger = logging.getLogger(__name__)

DEFAULT = "default"
"""Name of the row that all others are compared with."""

_CORNERS = ("window.angle=arms", "window.collinearity=relative")


def _in_flight(losses: str) -> tuple[str, ...]:
    """These losses, and no others, in every window while flying."""
    names = ", ".join(f'"{name}"' for name in losses.split())
    return ("window.in_flight=always", f"window.in_flight_losses=[{names}]")


@dataclass(frozen=True, slots=True)
class Row:
    """One line of the table."""

    name: str
    title: str
    overrides: tuple[str, ...]
    """``section.key=value`` on top of the defaults."""
    against: str = DEFAULT
    """Name of the row it is compared with."""
    own_sigma: bool = False
    """Whether the depth network's own sigma is used without the lower bound of `prior_anchors.MIN_SIGMA_LOG`."""


ROWS = (
    Row(DEFAULT, "default", ()),
    Row("points", "points alone: no edge term", ("window.alignment=false", "window.cycle=off")),
    Row("no-reprojection", "no reprojection loss", ("window.reprojection=off",)),
    Row("no-alignment", "no edge alignment", ("window.alignment=false",)),
    Row("no-cycle", "no cycle loss", ("window.cycle=off",)),
    Row("corners", "with L-shape loss (angle and collinearity)", _CORNERS),
    Row("corners-no-angle", "L-shape without angle", ("window.collinearity=relative",), "corners"),
    Row("corners-no-collinearity", "L-shape without collinearity", ("window.angle=arms",), "corners"),
    Row("literal-reprojection", "literal reprojection (eqs. 15-16)", ("window.reprojection=literal",)),
    Row("literal-cycle", "literal cycle (eqs. 17-23)", ("window.cycle=literal", "window.adaptive=false")),
    Row("cosine-angle", "cosine across views for the arms", ("window.angle=cosine", _CORNERS[1]), "corners"),
    Row("literal-angle", "literal angle (eqs. 24-25)", ("window.angle=literal", _CORNERS[1]), "corners"),
    Row(
        "literal-collinearity", "literal collinearity (eq. 26)", (_CORNERS[0], "window.collinearity=literal"), "corners"
    ),
    Row(
        "literal-total",
        "the paper's total (eq. 28), all literal",
        (
            *_in_flight("cycle collinearity"),
            "window.reprojection=literal",
            "window.alignment=false",
            "window.cycle=literal",
            "window.angle=literal",
            "window.collinearity=literal",
            "window.adaptive=false",
        ),
    ),
    Row("fixed-weights", "fixed weights: no adaptive scales", ("window.adaptive=false",)),
    Row("no-edge-tracking", "edges off in tracking", ("tracking.edges=false",)),
    Row("flight-off", "edges off in the flying windows", ("window.in_flight=off",)),
    Row("flight-always", "edges in all flying windows", _in_flight("alignment cycle")),
    Row("flight-alignment", "in all: alignment, no cycle", _in_flight("alignment"), "flight-always"),
    Row("flight-cycle", "in all: cycle, no alignment", _in_flight("cycle"), "flight-always"),
    Row("flight-angle", "in all: with angle", _in_flight("alignment cycle angle"), "flight-always"),
    Row(
        "flight-collinearity", "in all: with collinearity", _in_flight("alignment cycle collinearity"), "flight-always"
    ),
    Row("ungated-network", "network prior with its own sigma", (), own_sigma=True),
    Row("no-depth-network", "no depth network", ("depth.weights=none",)),
    Row("no-flow", "no optical flow: every frame matched", ("flow.enabled=false",)),
    Row("whole-pixels", "corners on whole pixels, as ORB finds them", ("mapping.sub_pixel=false",)),
)
"""The table of `edgeslam ablation`, top to bottom."""


@dataclass(frozen=True, slots=True)
class AblationSettings:
    """What to run."""

    data: Path
    """Folder of recordings."""
    seeds: tuple[int, ...] = (0, 1)
    sequences: tuple[str, ...] = ()
    """Names; all when empty."""
    rows: tuple[str, ...] = ()
    """Names of `ROWS`; all when empty. The rows they are compared with are run too."""
    max_frames: int | None = None
    overrides: tuple[str, ...] = ()
    """``section.key=value`` under every row's own."""


_COLUMNS = (
    ("ate_sim3_m", "ATE [mm]", 1e3, "{:.1f}"),
    ("ate_online_sim3_m", "online [mm]", 1e3, "{:.1f}"),
    ("map_median_m", "map error [mm]", 1e3, "{:.1f}"),
    ("edges_within_2cm", "edges in 2 cm", 1e2, "{:.0f} %"),
    ("map_points", "points", 1.0, "{:.0f}"),
    ("supported", "supported", 1e2, "{:.0f} %"),
    ("scale_error_abs", "scale off", 1e2, "{:.1f} %"),
    ("cpu_ms_per_frame", "CPU [ms/frame]", 1.0, "{:.0f}"),
    ("finish_ms", "last refinement [ms]", 1.0, "{:.0f}"),
)
_SHORT = {
    "ate_sim3_m": "ATE",
    "ate_online_sim3_m": "online",
    "map_median_m": "map",
    "edges_within_2cm": "edges found",
    "map_points": "points",
}
"""The judged figures."""


@dataclass(frozen=True, slots=True)
class _Flight:
    """A recording flown to its last frame, with nothing refined after it."""

    state: bytes
    """Pickled map, edge map, log and camera: every row starts from its own copy."""
    frames: int
    cpu_s: float
    metres_per_unit: float
    """NaN while the scale is unknown."""
    online: Trajectory
    """Poses as they were known live."""


def run_ablation(settings: AblationSettings, out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Run every sequence with every seed, and refine it for every row.

    The record is written after every run; runs that an earlier call with the same settings left in ``out`` are not
    repeated.

    Args:
        settings: What to run.
        out: Folder of ``ablation.json``.
        say: Called with one line for every run.

    Returns:
        The record: conditions, and for every row of `ROWS` by name its runs with their figures.

    Raises:
        EvaluationError: If a row or a sequence does not exist.
    """
    sequences, rows = _sequences(settings), _rows(settings.rows)
    out.mkdir(parents=True, exist_ok=True)
    path = out / "ablation.json"
    record = _earlier(path, settings) or {
        "version": __version__,
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "machine": machine(),
        "settings": _described(settings),
        "rows": {row.name: {"runs": []} for row in ROWS},
    }
    for name, folder in sequences.items():
        dataset = open_dataset(folder)
        for seed in settings.seeds:
            for sharing in _sharing(rows, settings, seed):
                todo = [(row, window) for row, window in sharing.rows if not _has(record, row, name, seed)]
                if not todo:
                    continue
                say(f"{name}, seed {seed}: flying for {', '.join(row.name for row, _ in todo)}")
                with _network_believed(sharing.own_sigma):
                    flight = _fly(folder, sharing.config, settings.max_frames)
                for row, window in todo:
                    figures = _finish(flight, window, dataset)
                    run = {"sequence": name, "seed": seed, "figures": figures, "error": ""}
                    record["rows"][row.name]["runs"].append(run)
                    write_text(path, json.dumps(record, indent=1) + "\n")
                    say(f"{name}, seed {seed}, {row.name}: ATE {figures['ate_sim3_m']:.4f} m")
    return record


def markdown_ablation(record: dict[str, Any]) -> str:
    """One table a sequence: medians over the seeds, and whether a row differs from the one it is compared with.

    "worse" and "better" are the row's, beyond twice the seeds' scatter and the benchmark's floor (`compare`);
    what is not named is the same.
    """
    records = {name: row for name, row in record["rows"].items() if row["runs"]}
    settings = record["settings"]
    frames = "all frames" if settings["max_frames"] is None else f"first {settings['max_frames']} frames"
    parts = [
        f"EdgeSLAM-Torch {record['version']}, {record['made']}, {frames}, seeds "
        f"{' '.join(str(s) for s in settings['seeds'])}, medians; {record['machine']['cores']} x "
        f"{record['machine']['cpu']}"
    ]
    for sequence in dict.fromkeys(run["sequence"] for row in records.values() for run in row["runs"]):
        titles = ["", *(title for _, title, _, _ in _COLUMNS), "beside"]
        parts += ["", f"### {sequence}", "", "| " + " | ".join(titles) + " |", "|" + "---|" * len(titles)]
        for row in (row for row in ROWS if row.name in records):
            cells = [_cell(records[row.name], sequence, *column) for column in _COLUMNS]
            parts.append(f"| {row.title} | " + " | ".join([*cells, _verdict(records, row, sequence)]) + " |")
    return "\n".join(parts) + "\n"


@dataclass(frozen=True, slots=True)
class _Sharing:
    """Rows that one flight serves."""

    config: SlamConfig
    own_sigma: bool
    rows: tuple[tuple[Row, WindowConfig], ...]


def _sharing(rows: Iterable[Row], settings: AblationSettings, seed: int) -> list[_Sharing]:
    """Rows by what matters before the last refinement: of the window's terms only those in flight."""
    groups: dict[tuple[SlamConfig, bool], list[tuple[SlamConfig, Row]]] = {}
    for row in rows:
        config = load_config(replace(SlamConfig(), seed=seed), None, (*settings.overrides, *row.overrides))
        flying = config.window.flying or WindowConfig(in_flight="off")
        flown = replace(
            config, window=replace(flying, reprojection=config.window.reprojection, rounds=1, adaptive=True)
        )
        groups.setdefault((flown, row.own_sigma), []).append((config, row))
    return [
        _Sharing(members[0][0], own_sigma, tuple((row, config.window) for config, row in members))
        for (_, own_sigma), members in groups.items()
    ]


@contextmanager
def _network_believed(own_sigma: bool) -> Iterator[None]:
    """The lower bound on the sigma of predicted depths, lifted for a while."""
    bound = prior_anchors.MIN_SIGMA_LOG
    prior_anchors.MIN_SIGMA_LOG = 0.0 if own_sigma else bound
    try:
        yield
    finally:
        prior_anchors.MIN_SIGMA_LOG = bound


def _fly(folder: Path, config: SlamConfig, max_frames: int | None) -> _Flight:
    source = open_source(folder)
    try:
        slam = EdgeSlam(source.camera, config)
        start = time.process_time()
        live = [slam.step(frame) for frame in islice(source.frames(), max_frames)]
        cpu_s = time.process_time() - start
    finally:
        source.close()
    scale = slam.scale
    return _Flight(
        pickled((slam.map, slam.edges, slam.log, slam.camera)),
        len(live),
        cpu_s,
        scale.value if np.isfinite(scale.sigma) else float("nan"),
        Trajectory(np.array([o.stamp_s for o in live]), np.stack([o.T_w_c for o in live])),
    )


def _finish(flight: _Flight, window: WindowConfig, dataset: EvalDataset) -> dict[str, float | None]:
    """Refine a copy of the flight and judge it."""
    state: tuple[SlamMap, EdgeMap, TrajectoryLog, Camera] = pickle.loads(flight.state)
    slam_map, edges, log, camera = state
    start = time.process_time()
    last_refinement(slam_map, camera, edges, window)
    finish_s = time.process_time() - start
    stamps, T_w_c = log.poses()
    estimate = Trajectory(stamps, T_w_c)
    score = score_trajectory(dataset.truth, estimate, AlignmentKind.SIM3)
    figures: dict[str, float | None] = {
        "ate_sim3_m": score.ate_m.rmse,
        "ate_online_sim3_m": score_trajectory(dataset.truth, flight.online, AlignmentKind.SIM3).ate_m.rmse,
        "supported": float(np.mean([record.supported for record in log.records])),
        "map_points": float(len(edges.points().p_w)),
        "scale_error_abs": abs(score.alignment.scale / flight.metres_per_unit - 1.0),
        "cpu_ms_per_frame": 1e3 * (flight.cpu_s + finish_s) / max(flight.frames, 1),
        "finish_ms": 1e3 * finish_s,
    }
    alignment = score.alignment
    if dataset.depth is not None:
        if not dataset.depth.is_registered:
            # The true poses are the depth camera's; ours are the colour camera's.
            T, known = interpolate(dataset.truth, stamps)
            colour = T @ np.linalg.inv(dataset.depth.T_c_d)
            alignment = umeyama(estimate.positions[known], colour[known, :3, 3])
        try:
            found = score_map(edges.points().p_w, alignment, surface_truth(dataset.folder.resolve()))
        except EvaluationError as error:
            logger.warning("no map score: %s", error)
        else:
            figures |= {"map_median_m": found.median_m, "edges_within_2cm": found.completeness.get(0.02)}
    return {k: float(v) if v is not None and np.isfinite(v) else None for k, v in figures.items()}


class _Pickler(pickle.Pickler):
    """Pickles a map: the copy gets a lock of its own."""

    def reducer_override(self, obj: object) -> Any:
        if isinstance(obj, type(threading.RLock())):
            return threading.RLock, ()
        return NotImplemented


def pickled(state: object) -> bytes:
    """Records of a flight as bytes, maps and their locks included."""
    buffer = io.BytesIO()
    _Pickler(buffer, protocol=pickle.HIGHEST_PROTOCOL).dump(state)
    return buffer.getvalue()


def _sequences(settings: AblationSettings) -> dict[str, Path]:
    found = find_sequences(settings.data, min_hz=0.0)
    missing = [name for name in settings.sequences if name not in found]
    if missing or not found:
        raise EvaluationError(
            f"no sequence {missing[0] if missing else ''!r} in {settings.data}; there are {list(found)}"
        )
    return {name: found[name] for name in settings.sequences or found}


def _rows(names: Sequence[str]) -> list[Row]:
    known = {row.name: row for row in ROWS}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise EvaluationError(f"no row {unknown[0]!r}; there are {', '.join(known)}")
    wanted = set(names or known)
    wanted |= {known[name].against for name in wanted} | {DEFAULT}
    return [row for row in ROWS if row.name in wanted]


def _described(settings: AblationSettings) -> dict[str, Any]:
    """Conditions that must match to continue an earlier record."""
    return {
        "seeds": list(settings.seeds),
        "max_frames": settings.max_frames,
        "overrides": list(settings.overrides),
    }


def _earlier(path: Path, settings: AblationSettings) -> dict[str, Any] | None:
    if not path.is_file():
        return None
    record = read_mapping(path, "JSON", EvaluationError)
    if record.get("settings") != _described(settings):
        raise EvaluationError(f"{path}: recorded with other settings; give another --out")
    return record


def _has(record: dict[str, Any], row: Row, sequence: str, seed: int) -> bool:
    return any(run["sequence"] == sequence and run["seed"] == seed for run in record["rows"][row.name]["runs"])


def _cell(record: dict[str, Any], sequence: str, name: str, _title: str, factor: float, text: str) -> str:
    runs = [run for run in record["runs"] if run["sequence"] == sequence]
    found = [run["figures"][name] for run in runs if run["figures"].get(name) is not None]
    if not found:
        return "failed" if any(run["error"] for run in runs) else "-"
    return text.format(factor * float(np.median(found)))


def _verdict(records: dict[str, dict[str, Any]], row: Row, sequence: str) -> str:
    if row.name == row.against or row.against not in records:
        return ""
    found = compare(records[row.against], records[row.name])
    told = [
        f"{_SHORT[c['metric']]} {c['verdict']}"
        for c in found
        if c["sequence"] == sequence and c["metric"] in _SHORT and c["verdict"] != "same"
    ]
    return f"{row.against}: {', '.join(told) or 'same'}"
