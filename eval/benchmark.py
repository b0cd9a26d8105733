"""The real job on every sequence at hand, several seeds, every run in its own process; kept as JSON, compared later.

Noise is stated, not assumed: two sets of runs differ when their medians are farther apart than
``2 sqrt(s_a^2/n_a + s_b^2/n_b)``, with ``s`` the sample standard deviation over the seeds, and than a floor per
figure (times on a shared machine move by more than seeds do).
"""

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch import __version__
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.dataset import open_dataset
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.run_score import RunScore, evaluate_run

SYNTHETIC = "synthetic"
"""Name of the simulated flight among the sequences."""

_LEAST_HZ = 15.0
"""Recordings with a lower frame rate are for training, not for tracking."""

_RUN_TIMEOUT_S = 1800.0
_FORMAT = 1
_PEERS = Path(__file__).with_name("peers.toml")
_OWN = "edgeslam"


_NOISE_WORDS = (
    "noise: 2 sqrt(s_a^2/n_a + s_b^2/n_b) over the seeds, and never less than the figure's floor (3 % for errors, 10 % "
    "for CPU time, 15 % for frames a second); one seed offline gives the same trajectory and map every time"
)


@dataclass(frozen=True, slots=True)
class Metric:
    """One figure of a run."""

    name: str
    title: str
    text: str
    lower_is_better: bool
    floor: float
    """Relative difference below which two medians are not told apart, however little the seeds scatter."""


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
    Metric("cpu_ms_per_frame", "CPU [ms/frame]", "{:.0f}", True, 0.10),
    Metric("fps", "frames/s", "{:.1f}", False, 0.15),
    Metric("peak_rss_mb", "memory [MB]", "{:.0f}", True, 0.05),
)


@dataclass(frozen=True, slots=True)
class BenchSettings:
    """What is run."""

    data: Path | None
    """Folder of recordings; None runs the synthetic flight alone."""
    seeds: tuple[int, ...] = (0, 1, 2)
    only: tuple[str, ...] = ()
    """Names of sequences; all when empty."""
    max_frames: int | None = None
    mode: str = "offline"
    overrides: tuple[str, ...] = ()
    """``section.key=value`` for ``edgeslam run --set``."""
    micro: bool = True
    """Time the solver's window and the depth network too."""


def find_sequences(data: Path | None) -> dict[str, Path]:
    """Recordings with ground truth and images at a camera's rate, by name.

    Raises:
        EvaluationError: If ``data`` is given but is no folder.
    """
    if data is None:
        return {}
    if not data.is_dir():
        raise EvaluationError(f"{data}: no such folder of recordings (--data or EDGESLAM_DATA)")
    found = {}
    for folder in [data, *sorted(p for p in data.iterdir() if p.is_dir())]:
        try:
            dataset = open_dataset(folder)
        except EdgeSlamError:
            continue
        stamps = dataset.frame_stamps_s
        if len(stamps) > 30 and 1.0 / float(np.median(np.diff(stamps))) >= _LEAST_HZ:
            found[dataset.name] = folder
    return found


def run_benchmark(settings: BenchSettings, out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Run everything into ``out`` and return the record that `compare` reads.

    Args:
        settings: What is run.
        out: Folder for the runs' own folders and ``bench.json``.
        say: Told one line before and after every run.

    Raises:
        EvaluationError: If a named sequence is not there.
    """
    begin = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    sequences = find_sequences(settings.data)
    names = settings.only or (*sequences, SYNTHETIC)
    missing = [n for n in names if n not in sequences and n != SYNTHETIC]
    if missing:
        raise EvaluationError(f"no sequence {missing[0]!r}; there are {', '.join([*sequences, SYNTHETIC])}")
    record: dict[str, Any] = {
        "format": _FORMAT,
        "version": __version__,
        "commit": _commit(),
        "made": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "machine": machine(),
        "seeds": list(settings.seeds),
        "mode": settings.mode,
        "max_frames": settings.max_frames,
        "overrides": list(settings.overrides),
        "runs": [],
    }
    # All runs first, then all judging: on Linux a child's peak memory starts from its parent's at the time of the
    # fork, and the measured surfaces take a gigabyte.
    folders = {name: sequences.get(name) or _record_synthetic(out, settings, say) for name in names}
    for name, folder in folders.items():
        for seed in settings.seeds:
            say(f"{name}, seed {seed} ...")
            record["runs"].append(_one_run(name, folder, seed, settings, out / f"{name}_seed{seed}"))
            _save(record, out / "bench.json")
    for run in record["runs"]:
        name, seed = run["sequence"], run["seed"]
        _judge(run, out / f"{name}_seed{seed}", folders[name])
        say(f"{name}, seed {seed}: {_one_line(run)}")
        _save(record, out / "bench.json")
    if settings.micro:
        say("solver window and depth network ...")
        record["solver"], record["depth"] = _guarded(_solver), _guarded(depth_latency)
    record["took_s"] = time.monotonic() - begin
    _save(record, out / "bench.json")
    return record


def figures_of(score: RunScore) -> dict[str, float | None]:
    """The benchmark's figures of one judged run."""
    summary = score.summary
    own: dict[str, float | None] = {
        "ate_sim3_m": score.ate_sim3_m,
        "ate_online_sim3_m": score.ate_online_sim3_m,
        "ate_se3_m": score.ate_se3_m if score.units == "metres" else None,
        "scale_error_abs": abs(score.scale_error) if score.units == "metres" else None,
        "coverage": score.coverage,
        "first_pose_s": score.first_pose_s,
        "rotation_deg": score.rotation_deg,
        "rpe_1s_m": score.rpe_1s_m,
        "full_transform": score.full_transform,
        "fps": summary.get("fps"),
        "cpu_ms_per_frame": summary.get("cpu_ms_per_frame"),
        "peak_rss_mb": summary.get("peak_rss_mb"),
        "dropped_frames": summary.get("dropped_frames"),
    }
    if score.map is not None:
        found = score.map
        own |= {
            "map_points": float(found.points),
            "map_median_m": found.median_m,
            "map_single_median_m": found.single_map_median_m,
            "map_own_alignment_median_m": found.own_alignment_median_m,
            "map_within_6cm": found.accuracy.get(0.06),
            "map_within_10cm": found.accuracy.get(0.10),
            "edges_within_2cm": found.completeness.get(0.02),
            "edges_within_6cm": found.completeness.get(0.06),
        }
    return {k: float(v) if v is not None and np.isfinite(v) else None for k, v in own.items()}


def compare(before: dict[str, Any], after: dict[str, Any]) -> list[dict[str, Any]]:
    """Figure by figure: medians, noise and verdict (``better``, ``worse``, ``same``) of two records."""
    rows = []
    for name in _sequences(before):
        if name not in _sequences(after):
            continue
        for metric in METRICS:
            a, b = _values(before, name, metric.name), _values(after, name, metric.name)
            if len(a) == 0 or len(b) == 0:
                continue
            noise = _noise(metric, a, b)
            change = float(np.median(b) - np.median(a))
            gain = -change if metric.lower_is_better else change
            verdict = "same" if abs(change) <= noise else "better" if gain > 0 else "worse"
            rows.append(
                {
                    "sequence": name,
                    "metric": metric.name,
                    "title": metric.title,
                    "text": metric.text,
                    "before": float(np.median(a)),
                    "after": float(np.median(b)),
                    "noise": noise,
                    "verdict": verdict,
                }
            )
    return rows


def markdown_bench(record: dict[str, Any]) -> str:
    """One table a sequence: every run, their median, and the peers' figures."""
    parts = [_conditions(record), "", _NOISE_WORDS]
    for name in _sequences(record):
        peers = [p for p in read_peers() if p["sequence"].startswith(name) or p["sequence"].split()[0] in name]
        runs = [r for r in record["runs"] if r["sequence"] == name]
        own = [(f"{_OWN}, seed {r['seed']}", _lists(r.get("figures", {}))) for r in runs]
        if len(runs) > 1:
            own.append((f"**{_OWN}, median of {len(runs)}**", _medians(record, name)))
            own.append(("its noise: two of these differ by less (±)", _noise_of(record, name)))
        other = [(f"{_peer_name(p, name)} [{k}]", _peer_figures(p)) for k, p in enumerate(peers, start=1)]
        parts += ["", f"### {name}", "", _table([*own, *other])]
        errors = [f"- seed {r['seed']} failed: {r['error']}" for r in runs if r.get("error")]
        notes = [f"[{k}] {p['source']}; {p['conditions']}" for k, p in enumerate(peers, start=1)]
        parts += ([""] + errors if errors else []) + ([""] + notes if notes else [])
        stages = _stages(runs)
        if stages:
            parts += ["", "stage, mean ms a frame: " + ", ".join(f"{k} {v:.1f}" for k, v in stages)]
    for key, title in (("solver", "solver window, CPU ms"), ("depth", "depth network, one thread, ms an image")):
        found = record.get(key)
        if found:
            parts += ["", f"{title}: " + ", ".join(f"{k} {v}" for k, v in found.items())]
    return "\n".join(parts) + "\n"


def markdown_compare(rows: Sequence[dict[str, Any]]) -> str:
    """The comparison as a table."""
    lines = ["| sequence | figure | before | after | noise | verdict |", "|---|---|---|---|---|---|"]
    for r in rows:
        before, after, noise = (r["text"].format(r[k]) for k in ("before", "after", "noise"))
        lines.append(f"| {r['sequence']} | {r['title']} | {before} | {after} | ±{noise} | {r['verdict']} |")
    lines += ["", _NOISE_WORDS]
    return "\n".join(lines) + "\n"


def read_peers(path: Path = _PEERS) -> list[dict[str, Any]]:
    """Stored figures of other systems, each with its source and conditions."""
    return list(tomllib.loads(path.read_text(encoding="utf-8"))["peer"])


def read_record(path: Path) -> dict[str, Any]:
    """A record that `run_benchmark` wrote.

    Raises:
        EvaluationError: If the file is missing or no such record.
    """
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise EvaluationError(f"{path}: cannot be read ({error.strerror})") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise EvaluationError(f"{path}: not JSON ({error})") from error
    if not isinstance(record, dict) or record.get("format") != _FORMAT or "runs" not in record:
        raise EvaluationError(f"{path}: not a result of 'edgeslam bench' (format {_FORMAT})")
    return record


def machine() -> dict[str, Any]:
    """What the times depend on."""
    model = ""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
        model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    return {
        "cpu": model or platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": platform.platform(),
        "python": platform.python_version(),
    }


def depth_latency(repeats: int = 20) -> dict[str, float | str]:
    """Median milliseconds of the shipped depth network in onnxruntime, float32 and int8, one thread."""
    import onnxruntime

    from edgeslam_torch.models.checkpoint import load_checkpoint
    from edgeslam_torch.models.export_onnx import ExportOptions, export_onnx
    from edgeslam_torch.models.quantize import quantize_int8

    network, metadata = load_checkpoint(None)
    height, width = metadata.input_height, metadata.input_width
    rng = np.random.default_rng(0)
    images = [rng.random((1, 3, height, width), dtype=np.float32) for _ in range(8)]
    out: dict[str, float | str] = {"size": f"{width}x{height}"}
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    with tempfile.TemporaryDirectory() as folder:
        plain, small = Path(folder) / "float32.onnx", Path(folder) / "int8.onnx"
        export_onnx(network, metadata, plain, ExportOptions(height, width))
        quantize_int8(plain, small, images)
        for name, path in (("fp32", plain), ("int8", small)):
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
            feed = {session.get_inputs()[0].name: images[0]}
            times = []
            for _ in range(repeats + 3):
                start = time.perf_counter()
                session.run(None, feed)
                times.append(1e3 * (time.perf_counter() - start))
            out[name] = round(float(np.median(times[3:])), 2)
    return out


def _solver() -> dict[str, Any]:
    from edgeslam_torch.optim.benchmark import benchmark

    return dict(benchmark(repeats=3))


def _guarded(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """A measurement that an installation cannot make (no weights, no onnx) is left out and says why."""
    try:
        return measure()
    except (EdgeSlamError, ImportError, RuntimeError, OSError) as error:
        return {"not measured": f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"}


def _one_run(name: str, folder: Path, seed: int, settings: BenchSettings, out: Path) -> dict[str, Any]:
    """One run in its own process, not judged yet."""
    command = [sys.executable, "-m", "edgeslam_torch.cli", "run", str(folder), "--out", str(out)]
    command += ["--seed", str(seed), "--mode", settings.mode, "--no-progress", "--no-report"]
    command += ["--max-frames", str(settings.max_frames)] if settings.max_frames is not None else []
    for override in settings.overrides:
        command += ["--set", override]
    run: dict[str, Any] = {"sequence": name, "seed": seed, "figures": {}, "stages": {}, "error": ""}
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_RUN_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return run | {"error": f"took longer than {_RUN_TIMEOUT_S:.0f} s"}
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines()
        return run | {"error": lines[-1] if lines else f"exit code {done.returncode}"}
    return run | {"load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None}


def _judge(run: dict[str, Any], out: Path, folder: Path) -> None:
    """Add figures to a run that ended well."""
    if run["error"]:
        return
    try:
        score = evaluate_run(out, folder)
    except EdgeSlamError as error:
        run["error"] = str(error)
        return
    run["figures"] = figures_of(score)
    run["stages"] = score.summary.get("stage_mean_ms_per_frame") or {}
    run["scale_inside_95"] = score.scale_inside_95
    run["notes"] = list(score.notes)


def _record_synthetic(out: Path, settings: BenchSettings, say: Callable[[str], None]) -> Path:
    """The simulated flight, recorded once: the seeds vary the system, not the world."""
    folder = out / "synthetic"
    flight = folder / "flight"
    if not (flight / "groundtruth.txt").is_file():
        say("recording the synthetic flight ...")
        command = [sys.executable, "-m", "edgeslam_torch.cli", "demo", "--record-only", "--out", str(folder)]
        if settings.max_frames is not None:  # no longer than what is looked at, at the demo's 20 Hz
            command += ["--seconds", str(max(2, -(-settings.max_frames // 20)))]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise EvaluationError(f"the synthetic flight could not be recorded: {done.stderr.strip()[-300:]}")
    return flight


def _commit() -> str:
    """Commit of the source tree, with a mark when it has changes; empty outside one."""
    here = Path(__file__).resolve().parent
    try:
        head = subprocess.run(
            ["git", "-C", str(here), "describe", "--always", "--dirty"], capture_output=True, text=True, check=False
        )
    except OSError:
        return ""
    return head.stdout.strip() if head.returncode == 0 else ""


def _save(record: dict[str, Any], path: Path) -> None:
    path.write_text(json.dumps(record, indent=1, default=str) + "\n", encoding="utf-8")


def _one_line(run: dict[str, Any]) -> str:
    if run["error"]:
        return f"failed: {run['error']}"
    f = run["figures"]
    text = f"ATE {f['ate_sim3_m']:.4f} m, coverage {f['coverage']:.1%}"
    if f.get("map_median_m") is not None:
        text += f", map {f['map_points']:.0f} points, {f['map_median_m']:.4f} m"
    return text + (f", {f['cpu_ms_per_frame']:.0f} ms CPU a frame" if f.get("cpu_ms_per_frame") else "")


def _sequences(record: dict[str, Any]) -> list[str]:
    return list(dict.fromkeys(r["sequence"] for r in record["runs"]))


def _values(record: dict[str, Any], sequence: str, name: str) -> np.ndarray:
    found = [r["figures"].get(name) for r in record["runs"] if r["sequence"] == sequence]
    return np.array([v for v in found if v is not None], dtype=np.float64)


def _scatter(a: np.ndarray, b: np.ndarray) -> float:
    parts = [np.var(x, ddof=1) / len(x) for x in (a, b) if len(x) > 1]
    return float(2.0 * np.sqrt(sum(parts)))


def _lists(figures: dict[str, float | None]) -> dict[str, list[float]]:
    return {k: [v] for k, v in figures.items() if v is not None}


def _noise_of(record: dict[str, Any], name: str) -> dict[str, list[float]]:
    """What `compare` would call no difference between this record's median and that of a second one like it."""
    out = {}
    for metric in METRICS:
        values = _values(record, name, metric.name)
        if len(values):
            out[metric.name] = [_noise(metric, values, values)]
    return out


def _noise(metric: Metric, a: np.ndarray, b: np.ndarray) -> float:
    return max(_scatter(a, b), metric.floor * abs(float(np.median(a))))


def _medians(record: dict[str, Any], name: str) -> dict[str, list[float]]:
    out = {}
    for metric in METRICS:
        values = _values(record, name, metric.name)
        if len(values):
            out[metric.name] = [float(np.median(values))]
    return out


def _peer_name(peer: dict[str, Any], sequence: str) -> str:
    """System, and on what, where its figure is not of this very sequence."""
    return str(peer["system"]) if peer["sequence"] == sequence else f"{peer['system']}, {peer['sequence']}"


def _peer_figures(peer: dict[str, Any]) -> dict[str, list[float]]:
    names = {"ate_m": "ate_sim3_m"}
    out = {}
    for key, value in peer.items():
        if isinstance(value, (int, float, list)):
            out[names.get(key, key)] = [float(v) for v in value] if isinstance(value, list) else [float(value)]
    return out


def _table(rows: Iterable[tuple[str, dict[str, list[float]]]]) -> str:
    rows = list(rows)
    used = [m for m in METRICS if any(m.name in figures for _, figures in rows)]
    lines = ["| system | " + " | ".join(m.title for m in used) + " |", "|" + "---|" * (len(used) + 1)]
    for title, figures in rows:
        cells = [" ".join(m.text.format(v) for v in figures[m.name]) if m.name in figures else "-" for m in used]
        lines.append(f"| {title} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _stages(runs: Sequence[dict[str, Any]]) -> list[tuple[str, float]]:
    names = dict.fromkeys(k for r in runs for k in r.get("stages", {}))
    means = [(n, float(np.mean([r["stages"].get(n, 0.0) for r in runs if r.get("stages")]))) for n in names]
    return sorted(means, key=lambda kv: -kv[1])


def _conditions(record: dict[str, Any]) -> str:
    m = record["machine"]
    loads = [run["load"] for run in record["runs"] if run.get("load") is not None]
    load = f", load average {min(loads):.1f} to {max(loads):.1f} during the runs" if loads else ""
    frames = f", only the first {record['max_frames']} frames of each sequence" if record.get("max_frames") else ""
    took = f", took {record['took_s'] / 60:.1f} minutes in all" if record.get("took_s") else ""
    return (
        f"EdgeSLAM-Torch {record['version']} {record['commit']}, {record['made']}, {record['mode']}{frames}, "
        f"{m['cores']} x {m['cpu']}{load}, Python {m['python']}{took}"
    )
