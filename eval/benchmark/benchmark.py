"""Runs of ``edgeslam run`` on every available sequence with several seeds; stored as JSON for comparison.

Between the runs the same fixed work is timed (`machine_speed`), and solver and depth network alone (`probes`); other
load is measured. `compare` derives noise and verdicts. `run_rows` makes the same runs with several sets of settings.
"""

import json
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch import __version__
from edgeslam_torch.eval.benchmark import probes
from edgeslam_torch.eval.benchmark.compare import (
    ALONE,
    FORMAT,
    METRICS,
    alone_metrics,
    busy_runs,
    medians_of,
    noise_of,
    reference_of,
    sequences_of,
    stage_metrics,
)
from edgeslam_torch.eval.benchmark.machine_speed import MachineSpeed, disturbance, read_cpu_times
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.conditions import code_state, machine
from edgeslam_torch.eval.experiment.figures import Figure
from edgeslam_torch.eval.experiment.runner import MODULE, Local, Task, run_tasks
from edgeslam_torch.eval.inputs.dataset import find_recordings
from edgeslam_torch.eval.metrics.run_score import RunScore, evaluate_run
from edgeslam_torch.eval.report.tables import markdown_table
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.jobs.watched import Limits, start_module

SYNTHETIC = "synthetic"
"""Name of the simulated flight among the sequences."""
_MIN_HZ = 15.0
"""Recordings with a lower frame rate are for training, not for tracking."""
_RUN_TIMEOUT_S = 1800.0
_PEERS = Path(__file__).with_name("peers.toml")
_CLI = "import sys; from edgeslam_torch.cli import main; sys.exit(main())"
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


def sequences(
    settings: BenchSettings, min_hz: float = _MIN_HZ, others: Sequence[str] = (SYNTHETIC,)
) -> dict[str, Path]:
    """Folders of the sequences to run, by name; of ``others`` there is none yet.

    Raises:
        EvaluationError: If a named sequence is not there.
    """
    found = {} if settings.data is None else find_recordings(settings.data, min_hz=min_hz)
    known = {name: folder for name, (folder, _) in found.items()} | dict.fromkeys(others, Path())
    missing = [name for name in settings.only if name not in known]
    if missing or not known:
        raise EvaluationError(f"no sequence {missing[0] if missing else ''!r}; there are {', '.join(known)}")
    return {name: known[name] for name in settings.only or known}


def run_benchmark(settings: BenchSettings, out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Run everything into ``out`` and return the record that `compare` reads.

    Args:
        settings: What is run.
        out: Folder for the runs' own folders and ``bench.json``.
        say: Told one line after every run.

    Raises:
        EvaluationError: If a named sequence is not there.
    """
    begin = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    folders = sequences(settings)
    if SYNTHETIC in folders:
        folders[SYNTHETIC] = _record_synthetic(out, settings, say)
    record: dict[str, Any] = {
        "format": FORMAT,
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
    tasks = {
        (name, seed): _task(out, f"{name}_seed{seed}", folder, seed, settings)
        for name, folder in folders.items()
        for seed in settings.seeds
    }
    with MachineSpeed() as speed:
        say("reference work ...")
        measure = probes.bout if settings.micro else probes.reference_alone
        speed.time(measure)  # loads and warms everything
        bouts: list[dict[str, Any]] = [speed.time(measure)]
        for run in _runs(tasks, say, resume=False):
            bouts.append(speed.time(measure))
            before, after = (bout["reference"] for bout in bouts[-2:])
            run["reference"] = {key: (before[key] + after[key]) / 2 for key in before}  # while the run went on
            run["figures"].pop("finish_ms", None)  # of the rows alone
            record["runs"].append(run)
            record |= probes.gather(bouts)
            _save(record, out / "bench.json")
    record["took_s"] = time.monotonic() - begin
    _save(record, out / "bench.json")
    return record


def run_rows(
    settings: BenchSettings,
    rows: Mapping[str, tuple[Sequence[str], str]],
    out: Path,
    say: Callable[[str], None],
    min_hz: float = 0.0,
) -> dict[str, dict[str, Any]]:
    """The runs of a benchmark, without its timing, once with every row's settings; results in ``out`` are kept.

    Args:
        settings: What is run.
        rows: ``section.key=value`` by the row's name, and a statement that its process executes first.
        out: Folder for the runs.
        say: Told one line after every run.
        min_hz: Least frame rate of a recording.

    Returns:
        A record of each row, whose ``runs`` `compare` reads.

    Raises:
        EvaluationError: If a named sequence is not there.
    """
    folders = sequences(settings, min_hz, ())
    tasks = {
        (name, seed, row): _task(out, f"{row}_{name}_seed{seed}", folder, seed, settings, overrides, first)
        for name, folder in folders.items()
        for seed in settings.seeds
        for row, (overrides, first) in rows.items()
    }
    records: dict[str, dict[str, Any]] = {row: {"runs": []} for row in rows}
    for (*_, row), run in zip(tasks, _runs(tasks, say), strict=True):
        records[row]["runs"].append(run)
    return records


def _task(
    out: Path, name: str, folder: Path, seed: int, settings: BenchSettings, more: Sequence[str] = (), first: str = ""
) -> Task:
    arguments = ["--seed", str(seed), "--mode", settings.mode, "--no-progress", "--no-report"]
    arguments += ["--max-frames", str(settings.max_frames)] if settings.max_frames is not None else []
    for override in (*settings.overrides, *more):
        arguments += ["--set", override]
    case = {"commit": _commit(), "recording": str(folder), "arguments": arguments, "first": first}
    return Task(
        out / "cases", name, "edgeslam_torch.eval.benchmark.benchmark:run_sequence", case, {"out": str(out / name)}
    )


@lru_cache(maxsize=1)
def _commit() -> str:
    """State of the code when the benchmark began."""
    return code_state()


def run_sequence(case: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Run and evaluate one sequence; what the process of a benchmark's case does.

    Raises:
        EvaluationError: If the run fails, or cannot be compared with its ground truth.
    """
    command = [sys.executable, "-c", f"{case['first']}\n{_CLI}", "run", case["recording"], "--out", case["out"]]
    begun, before_s = read_cpu_times(), _children_cpu_s()
    done = subprocess.run([*command, *case["arguments"]], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise EvaluationError(lines[-1] if lines else f"exit code {done.returncode}")
    cpu_s, found = _children_cpu_s() - before_s, disturbance(begun, read_cpu_times())
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    score = evaluate_run(case["out"], case["recording"])
    figures = figures_of(score)
    if cpu_s > 0:  # with start-up and writing, which the run itself cannot see
        figures["cpu_ms_per_frame"] = 1e3 * cpu_s / score.summary["frames"]
    return {
        "figures": figures,
        "stages": score.summary.get("stage_mean_ms_per_frame") or {},
        "load": load,
        "process_cpu_s": cpu_s,
        "disturbance": asdict(found) | {"busy": found.busy} if found is not None else None,
        "scale_inside_95": score.scale_inside_95,
        "notes": list(score.notes),
    }


def _runs(tasks: Mapping[Any, Task], say: Callable[[str], None], resume: bool = True) -> Iterable[dict[str, Any]]:
    """Runs of cases whose first two parts are sequence and seed, in the cases' order, one at a time."""
    start = partial(start_module, MODULE, environment={})  # threads as the user's own runs have them
    found = dict[Any, dict[str, Any]]()
    waiting = list(tasks)
    for case, result, ended in run_tasks(tasks, Local(1, Limits(_RUN_TIMEOUT_S), start=start), resume):
        run = {"sequence": case[0], "seed": case[1], "figures": {}, "stages": {}, "error": ""}
        run |= {"error": ended.reason.removesuffix(" (exit code 1)")} if result is None and ended else result or {}
        run.pop("key", None)
        found[case] = run
        if ended is not None:
            say(f"{case[0]}, seed {case[1]}{''.join(f', {part}' for part in case[2:])}: {_one_line(run)}")
        while waiting and waiting[0] in found:
            yield found.pop(waiting.pop(0))


def _children_cpu_s() -> float:
    """User and system time of all ended child processes; always 0 on Windows."""
    times = os.times()
    return times.children_user + times.children_system


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
        **{name: summary.get(name) for name in ("fps", "cpu_ms_per_frame", "peak_rss_mb", "dropped_frames")},
        "finish_ms": 1e3 * summary["finish_s"] if "finish_s" in summary else None,
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
    text += f", {f['cpu_ms_per_frame']:.0f} ms CPU per frame" if f.get("cpu_ms_per_frame") else ""
    other = run.get("disturbance")
    busy = f"; the machine is busy: others use {other['others']:.0%}, the host {other['stolen']:.0%}" if other else ""
    return text + (busy if other and other["busy"] else "")


def read_peers(path: Path = _PEERS) -> list[dict[str, Any]]:
    """Stored figures of other systems, each with its source and conditions."""
    return list(tomllib.loads(path.read_text(encoding="utf-8"))["peer"])


def markdown_bench(record: dict[str, Any]) -> str:
    """One table a sequence: every run, their median, and the peers' figures."""
    parts = [_conditions(record), "", _NOISE_WORDS]
    for name in sequences_of(record):
        peers = [p for p in read_peers() if p["sequence"].startswith(name) or p["sequence"].split()[0] in name]
        runs = [r for r in record["runs"] if r["sequence"] == name]
        rows = {f"edgeslam, seed {r['seed']}": r.get("figures", {}) for r in runs}
        if len(runs) > 1:
            rows[f"**edgeslam, median of {len(runs)}**"] = medians_of(record, name)
            rows["its noise: two of these differ by less (±)"] = noise_of(record, name)
        for k, peer in enumerate(peers, start=1):
            where = "" if peer["sequence"] == name else f", {peer['sequence']}"
            rows[f"{peer['system']}{where} [{k}]"] = peer | {"ate_sim3_m": peer["ate_m"]}
        used = [m for m in METRICS if any(figures.get(m.name) is not None for figures in rows.values())]
        cells = [[title, *(_values(m, figures.get(m.name)) for m in used)] for title, figures in rows.items()]
        parts += ["", f"### {name}", "", markdown_table(["system", *(m.title for m in used)], cells)]
        errors = [f"- seed {r['seed']} failed: {r['error']}" for r in runs if r.get("error")]
        notes = [f"[{k}] {p['source']}; {p['conditions']}" for k, p in enumerate(peers, start=1)]
        parts += ([""] + errors if errors else []) + ([""] + notes if notes else [])
        parts += _times_line("stages, mean ms per frame, median of the runs", record, name, stage_metrics(record, name))
    for part, title in (("solver", "solver window, CPU ms"), ("depth", "depth network, one thread, ms an image")):
        texts = [f"{k} {v}" for k, v in (record.get(part) or {}).items() if isinstance(v, str)]
        metrics = [m for m in alone_metrics(record) if m.name.startswith(part)]
        parts += _times_line(", ".join([title, *texts]), record, ALONE, metrics)
        parts += ["", f"{title}: {', '.join(texts)}"] if texts and not metrics else []
    return "\n".join([*parts, "", *_machine_lines(record)]) + "\n"


def _values(metric: Figure, values: Any) -> str:
    """Every value of a figure, of which a peer has a list."""
    if values is None:
        return "-"
    return " ".join(metric.text.format(v) for v in (values if isinstance(values, list) else [values]))


def _times_line(title: str, record: dict[str, Any], name: str, metrics: Sequence[Figure]) -> list[str]:
    """Medians of some times with their noise, in one line."""
    medians, noise = medians_of(record, name, metrics), noise_of(record, name, metrics)
    cells = [
        f"{m.title.split(' [')[0].split(' ', 1)[-1] if name == ALONE else m.title.split(' [')[0]} "
        f"{medians[m.name]:.2f} ±{noise[m.name]:.2f}"
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
