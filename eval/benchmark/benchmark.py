"""Runs on every available sequence with several seeds, each in its own process; stored as JSON for comparison.

Between the runs the same fixed work is timed (`machine_speed`), and solver and depth network alone (`bench_probes`);
other load is measured. `compare` derives noise and verdicts.
"""

import json
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch import __version__
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.benchmark import probes as bench_probes
from edgeslam_torch.eval.benchmark.compare import (
    ALONE,
    FORMAT,
    METRICS,
    Metric,
    alone_metrics,
    busy_runs,
    medians_of,
    noise_of,
    reference_of,
    sequences_of,
    stage_metrics,
)
from edgeslam_torch.eval.benchmark.conditions import code_state, machine
from edgeslam_torch.eval.benchmark.machine_speed import MachineSpeed, disturbance, read_cpu_times
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.eval.metrics.run_score import RunScore, evaluate_run
from edgeslam_torch.files.atomic import write_text

SYNTHETIC = "synthetic"
"""Name of the simulated flight among the sequences."""

_MIN_HZ = 15.0
"""Recordings with a lower frame rate are for training, not for tracking."""

_RUN_TIMEOUT_S = 1800.0
_PEERS = Path(__file__).with_name("peers.toml")
_OWN = "edgeslam"


_NOISE_WORDS = (
    "noise: what two such medians differ by without meaning anything. Accuracy: 2 sqrt(s_a^2/n_a + s_b^2/n_b) over the "
    "seeds; one seed offline gives the same trajectory and map every time. Times: at one machine speed (the reference "
    "work timed beside every run), 3.75 sqrt(s_a^2/n_a + s_b^2/n_b) with the relative scatter of all sequences. Never "
    "less than the figure's floor (3 % for errors, 10 % for CPU time, 15 % for frames per second and stages)"
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


def find_sequences(data: Path | None, min_hz: float = _MIN_HZ) -> dict[str, Path]:
    """Recordings with ground truth and images at no less than a rate, by name; a camera's rate when none is given.

    ``data`` itself, its folders and theirs are looked at.

    Raises:
        EvaluationError: If ``data`` is given but is no folder.
    """
    if data is None:
        return {}
    if not data.is_dir():
        raise EvaluationError(f"{data}: no such folder of recordings (--data or EDGESLAM_DATA)")
    found: dict[str, Path] = {}
    folders = sorted(p for p in data.iterdir() if p.is_dir())
    deeper = [p for folder in folders for p in sorted(folder.iterdir()) if p.is_dir()]
    for folder in [data, *folders, *deeper]:
        if folder.parent in found.values():  # a part of a recording
            continue
        try:
            dataset = open_dataset(folder)
        except EdgeSlamError:
            continue
        stamps = dataset.frame_stamps_s
        if len(stamps) > 30 and 1.0 / float(np.median(np.diff(stamps))) >= min_hz:
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
        "format": FORMAT,
        "version": __version__,
        "commit": code_state(),
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
    bouts: list[dict[str, Any]] = []
    with MachineSpeed() as speed:
        say("reference work ...")
        measure = bench_probes.bout if settings.micro else bench_probes.reference_alone
        speed.time(measure)  # loads and warms everything
        bouts.append(speed.time(measure))
        for name, folder in folders.items():
            for seed in settings.seeds:
                say(f"{name}, seed {seed} ...")
                begun = read_cpu_times()
                run = _one_run(name, folder, seed, settings, out / f"{name}_seed{seed}")
                found = disturbance(begun, read_cpu_times())
                bouts.append(speed.time(measure))
                run["disturbance"] = asdict(found) | {"busy": found.busy} if found is not None else None
                run["reference"] = _between(bouts[-2]["reference"], bouts[-1]["reference"])
                record["runs"].append(run)
                record |= bench_probes.gather(bouts)
                _save(record, out / "bench.json")
                if found is not None and found.busy:
                    say(f"the machine is busy: others use {found.others:.0%}, the host {found.stolen:.0%} of it")
    for run in record["runs"]:
        name, seed = run["sequence"], run["seed"]
        _judge(run, out / f"{name}_seed{seed}", folders[name])
        say(f"{name}, seed {seed}: {_one_line(run)}")
        _save(record, out / "bench.json")
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


def markdown_bench(record: dict[str, Any]) -> str:
    """One table a sequence: every run, their median, and the peers' figures."""
    parts = [_conditions(record), "", _NOISE_WORDS]
    for name in sequences_of(record):
        peers = [p for p in read_peers() if p["sequence"].startswith(name) or p["sequence"].split()[0] in name]
        runs = [r for r in record["runs"] if r["sequence"] == name]
        own = [(f"{_OWN}, seed {r['seed']}", _lists(r.get("figures", {}))) for r in runs]
        if len(runs) > 1:
            own.append((f"**{_OWN}, median of {len(runs)}**", medians_of(record, name)))
            own.append(("its noise: two of these differ by less (±)", noise_of(record, name)))
        other = [(f"{_peer_name(p, name)} [{k}]", _peer_figures(p)) for k, p in enumerate(peers, start=1)]
        parts += ["", f"### {name}", "", _table([*own, *other])]
        errors = [f"- seed {r['seed']} failed: {r['error']}" for r in runs if r.get("error")]
        notes = [f"[{k}] {p['source']}; {p['conditions']}" for k, p in enumerate(peers, start=1)]
        parts += ([""] + errors if errors else []) + ([""] + notes if notes else [])
        parts += _times_line("stages, mean ms per frame, median of the runs", record, name, stage_metrics(record, name))
    for part, title in (("solver", "solver window, CPU ms"), ("depth", "depth network, one thread, ms an image")):
        texts = [f"{k} {v}" for k, v in (record.get(part) or {}).items() if isinstance(v, str)]
        metrics = [m for m in alone_metrics(record) if m.name.startswith(part)]
        parts += _times_line(", ".join([title, *texts]), record, ALONE, metrics)
        if texts and not metrics:
            parts += ["", f"{title}: {', '.join(texts)}"]
    parts += ["", *_machine_lines(record)]
    return "\n".join(parts) + "\n"


def read_peers(path: Path = _PEERS) -> list[dict[str, Any]]:
    """Stored figures of other systems, each with its source and conditions."""
    return list(tomllib.loads(path.read_text(encoding="utf-8"))["peer"])


def _between(before: dict[str, float], after: dict[str, float]) -> dict[str, float]:
    """The reference work's times while a run went on: the mean of right before and right after."""
    return {key: (before[key] + after[key]) / 2 for key in before}


def _one_run(name: str, folder: Path, seed: int, settings: BenchSettings, out: Path) -> dict[str, Any]:
    """One run in its own process, not judged yet."""
    command = [sys.executable, "-m", "edgeslam_torch.cli", "run", str(folder), "--out", str(out)]
    command += ["--seed", str(seed), "--mode", settings.mode, "--no-progress", "--no-report"]
    command += ["--max-frames", str(settings.max_frames)] if settings.max_frames is not None else []
    for override in settings.overrides:
        command += ["--set", override]
    run: dict[str, Any] = {"sequence": name, "seed": seed, "figures": {}, "stages": {}, "error": ""}
    before_s = _children_cpu_s()
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_RUN_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return run | {"error": f"took longer than {_RUN_TIMEOUT_S:.0f} s"}
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines()
        return run | {"error": lines[-1] if lines else f"exit code {done.returncode}"}
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return run | {"load": load, "process_cpu_s": _children_cpu_s() - before_s}


def _children_cpu_s() -> float:
    """User and system time of all ended child processes; always 0 on Windows."""
    times = os.times()
    return times.children_user + times.children_system


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
    if run["process_cpu_s"] > 0:  # with start-up and writing, which the run itself cannot see
        run["figures"]["cpu_ms_per_frame"] = 1e3 * run["process_cpu_s"] / score.summary["frames"]
    run["stages"] = score.summary.get("stage_mean_ms_per_frame") or {}
    run["scale_inside_95"] = score.scale_inside_95
    run["notes"] = list(score.notes)


def _record_synthetic(out: Path, settings: BenchSettings, say: Callable[[str], None]) -> Path:
    """The simulated flight, recorded once: seeds vary the system, not the world."""
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


def _save(record: dict[str, Any], path: Path) -> None:
    write_text(path, json.dumps(record, indent=1, default=str) + "\n")


def _one_line(run: dict[str, Any]) -> str:
    if run["error"]:
        return f"failed: {run['error']}"
    f = run["figures"]
    text = f"ATE {f['ate_sim3_m']:.4f} m, coverage {f['coverage']:.1%}"
    if f.get("map_median_m") is not None:
        text += f", map {f['map_points']:.0f} points, {f['map_median_m']:.4f} m"
    return text + (f", {f['cpu_ms_per_frame']:.0f} ms CPU per frame" if f.get("cpu_ms_per_frame") else "")


def _lists(figures: dict[str, float | None]) -> dict[str, list[float]]:
    return {k: [v] for k, v in figures.items() if v is not None}


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


def _times_line(title: str, record: dict[str, Any], name: str, metrics: Sequence[Metric]) -> list[str]:
    """Medians of some times with their noise, in one line."""
    medians, noise = medians_of(record, name, metrics), noise_of(record, name, metrics)
    cells = [
        f"{m.title.split(' [')[0].split(' ', 1)[-1] if name == ALONE else m.title.split(' [')[0]} "
        f"{medians[m.name][0]:.2f} ±{noise[m.name][0]:.2f}"
        for m in metrics
        if m.name in medians
    ]
    return ["", f"{title}: " + ", ".join(cells)] if cells else []


def _machine_lines(record: dict[str, Any]) -> list[str]:
    """Speed and load of the machine."""
    lines = []
    if len(found := reference_of(record, "cpu_ms")):
        spread = float(np.std(found, ddof=1) / np.mean(found)) if len(found) > 1 else 0.0
        lines.append(
            f"machine: reference work {np.median(found):.1f} ms CPU ({found.min():.1f} to {found.max():.1f}, "
            f"scatter {spread:.1%}) in {len(found)} bouts"
        )
    return lines + ([f"warning: {busy}"] if (busy := busy_runs(record)) else [])


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
