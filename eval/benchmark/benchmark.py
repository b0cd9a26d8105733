"""Runs of ``edgeslam run`` on every available sequence with several seeds: one record, as a table beside other systems.

Accuracy repeats to the byte for a seed, and times do not: CPU time is compared in passes of ORB, timed before and after
every run. `run_rows` makes the same runs with several sets of settings.
"""

import json
import os
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.experiment.conditions import code_state, machine, orb_pass_ms, stamp
from edgeslam_torch.eval.experiment.figures import Figure, grouped, markdown_table, plain
from edgeslam_torch.eval.experiment.runner import MODULE, Local, Task, check_own, run_all
from edgeslam_torch.eval.inputs.dataset import find_recordings
from edgeslam_torch.eval.metrics.run_score import RunScore, evaluate_run
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.jobs.watched import Limits, start_module

FORMAT = 3
"""Of a record; earlier ones had no figure of CPU time in passes of ORB."""
CASES = "cases"
"""Folder of the cases' folders."""
SYNTHETIC = "synthetic"
"""Name of the simulated flight among the sequences."""
_RUN_TIMEOUT_S = 1800.0
_SHORTEST_STAGE_MS = 0.05
"""Mean milliseconds a frame below which a stage is not named."""
_PEERS = Path(__file__).with_name("peers.toml")
_CLI = "import sys; from edgeslam_torch.cli import main; sys.exit(main())"

FIGURES = (
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
    Figure("cpu_ms_per_frame", "CPU [ms/frame]", "{:.1f}"),
    Figure("cpu_orb", "CPU [ORB/frame]", "{:.2f}", floor=0.10),
    Figure("fps", "frames/s", "{:.1f}"),
    Figure("peak_rss_mb", "memory [MB]", "{:.0f}", floor=0.05),
)
_OF_SCORE = (
    *("ate_sim3_m", "ate_online_sim3_m", "coverage", "first_pose_s"),
    *("rotation_deg", "rpe_1s_m", "full_transform"),
)
"""Figures with the names of a `RunScore`."""


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
    min_hz: float = 15.0
    """Recordings with a lower frame rate are for training, not for tracking."""


def sequences(settings: BenchSettings, others: Sequence[str] = ()) -> dict[str, Path]:
    """Folders of the sequences to run, by name; of ``others`` there is none yet.

    Raises:
        EvaluationError: If a named sequence is not there.
    """
    found = {} if settings.data is None else find_recordings(settings.data, min_hz=settings.min_hz)
    known = {name: folder for name, (folder, _) in found.items()} | dict.fromkeys(others, Path())
    missing = [name for name in settings.only if name not in known]
    if missing or not known:
        raise EvaluationError(f"no sequence {missing[0] if missing else ''!r}; there are {', '.join(known)}")
    return {name: known[name] for name in settings.only or known}


def run_benchmark(settings: BenchSettings, out: Path, say: Callable[[str], None]) -> dict[str, Any]:
    """Run everything into ``out``, write ``bench.json`` there and return what it holds; runs with the same code and
    settings that it holds are not repeated.

    Raises:
        EvaluationError: If a named sequence is not there.
        OutputError: If ``out`` holds what no benchmark wrote.
    """
    check_own(out, CASES, ("format", "runs"), "bench.json")
    begin = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    folders = sequences(settings, (SYNTHETIC,))
    if SYNTHETIC in folders:
        folders[SYNTHETIC] = _record_synthetic(out, settings, say)
    record: dict[str, Any] = {
        "format": FORMAT,
        **stamp(),
        "machine": machine(),
        **asked(settings),
        "mode": settings.mode,
        "runs": run_rows(settings, folders, {"": ((), "")}, out, say)[""],
        "took_s": time.monotonic() - begin,
    }
    write_text(out / "bench.json", json.dumps(record, indent=1, default=str) + "\n")
    return record


def asked(settings: BenchSettings) -> dict[str, Any]:
    """Settings of a record, in words."""
    seeds, overrides = list(settings.seeds), list(settings.overrides)
    return {"seeds": seeds, "max_frames": settings.max_frames, "overrides": overrides}


Key = tuple[str, int, str]
"""Of a run: sequence, seed and the row of settings."""


def run_rows(
    settings: BenchSettings,
    folders: Mapping[str, Path],
    rows: Mapping[str, tuple[Sequence[str], str]],
    out: Path,
    say: Callable[[str], None],
) -> dict[str, list[dict[str, Any]]]:
    """The runs once with every row's settings, one at a time; results in ``out`` are kept.

    Args:
        settings: What is run.
        folders: Recordings by the sequence's name.
        rows: ``section.key=value`` by the row's name, and a statement that its process executes first.
        out: Folder for the runs.
        say: Called with one line after every run.

    Returns:
        Runs of each row: sequence, seed, what `run_sequence` found, and why there is nothing.
    """
    commit, tasks = code_state(), dict[Key, Task]()
    for name, folder in folders.items():
        for seed in settings.seeds:
            for row, (overrides, first) in rows.items():
                arguments = ["--seed", str(seed), "--mode", settings.mode, "--no-progress", "--no-report"]
                arguments += [] if settings.max_frames is None else ["--max-frames", str(settings.max_frames)]
                arguments += [word for change in (*settings.overrides, *overrides) for word in ("--set", change)]
                case = {"commit": commit, "recording": str(folder), "arguments": arguments, "first": first}
                own = f"{row}_{name}_seed{seed}".removeprefix("_")
                function = f"{__name__}:run_sequence"
                tasks[name, seed, row] = Task(out / CASES, own, function, case, {"out": str(out / own)})
    start = partial(start_module, MODULE, environment={})  # threads as the user's own runs have them
    found = run_all(tasks, Local(1, Limits(_RUN_TIMEOUT_S), start=start), _run, _one_line, say)
    return {row: [found[key] for key in tasks if key[2] == row] for row in rows}


def _run(key: Key, found: dict[str, Any] | None, error: str) -> dict[str, Any]:
    run = {"sequence": key[0], "seed": key[1], "figures": {}, "stages": {}}
    return run | (found or {}) | {"error": error.removesuffix(" (exit code 1)")}


def run_sequence(case: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Run and evaluate one sequence; what the process of a benchmark's case does.

    Raises:
        EvaluationError: If the run fails, or cannot be compared with its ground truth.
    """
    command = [sys.executable, "-c", f"{case['first']}\n{_CLI}", "run", case["recording"], "--out", case["out"]]
    orb_ms = [orb_pass_ms()]
    done = subprocess.run([*command, *case["arguments"]], capture_output=True, text=True, check=False)
    orb_ms.append(orb_pass_ms())
    if done.returncode != 0:
        lines = (done.stderr or done.stdout).strip().splitlines()
        raise EvaluationError(lines[-1] if lines else f"exit code {done.returncode}")
    times = os.times()
    cpu_s = times.children_user + times.children_system  # always 0 on Windows
    score = evaluate_run(case["out"], case["recording"])
    figures = figures_of(score)
    if cpu_s > 0:  # with start-up and writing, which the run itself cannot see
        figures["cpu_ms_per_frame"] = 1e3 * cpu_s / score.summary["frames"]
    if figures["cpu_ms_per_frame"] is not None:
        figures["cpu_orb"] = figures["cpu_ms_per_frame"] / float(np.mean(orb_ms))
    return {
        "figures": figures,
        "stages": score.summary.get("stage_mean_ms_per_frame") or {},
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "process_cpu_s": cpu_s,
        "scale_inside_95": score.scale_inside_95,
        "notes": list(score.notes),
    }


def figures_of(score: RunScore) -> dict[str, float | None]:
    """The benchmark's figures of one judged run."""
    summary, is_metric = score.summary, score.units == "metres"
    own: dict[str, float | None] = {
        **{name: getattr(score, name) for name in _OF_SCORE},
        "ate_se3_m": score.ate_se3_m if is_metric else None,
        "scale_error_abs": abs(score.scale_error) if is_metric else None,
        **{name: summary.get(name) for name in ("fps", "cpu_ms_per_frame", "peak_rss_mb", "dropped_frames")},
        "finish_ms": 1e3 * summary["finish_s"] if "finish_s" in summary else None,
    }
    if (found := score.map) is not None:
        own |= {
            "map_points": found.points,
            "map_median_m": found.median_m,
            "map_single_median_m": found.single_map_median_m,
            "map_own_alignment_median_m": found.own_alignment_median_m,
            "map_within_6cm": found.accuracy.get(0.06),
            "map_within_10cm": found.accuracy.get(0.10),
            "edges_within_2cm": found.completeness.get(0.02),
            "edges_within_6cm": found.completeness.get(0.06),
        }
    return plain(own)


def _record_synthetic(out: Path, settings: BenchSettings, say: Callable[[str], None]) -> Path:
    """The simulated flight, recorded once: seeds vary the system, not the world."""
    folder = out / "synthetic"
    flight = folder / "flight"
    if not (flight / "groundtruth.txt").is_file():
        say("recording the synthetic flight ...")
        command = [sys.executable, "-m", "edgeslam_torch.cli", "demo", "--record-only", "--out", str(folder)]
        if settings.max_frames is not None:  # no longer than what is looked at, at the demo's 20 Hz
            command += ["--duration", str(max(2, -(-settings.max_frames // 20)))]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise EvaluationError(f"the synthetic flight could not be recorded: {done.stderr.strip()[-300:]}")
    return flight


def _one_line(key: Key, run: dict[str, Any]) -> str:
    name = f"{key[0]}, seed {key[1]}{f', {key[2]}' if key[2] else ''}"
    if run["error"]:
        return f"{name}: failed: {run['error']}"
    f = run["figures"]
    text = f"{name}: ATE {f['ate_sim3_m']:.4f} m, coverage {f['coverage']:.1%}"
    if f.get("map_median_m") is not None:
        text += f", map {f['map_points']:.0f} points, {f['map_median_m']:.4f} m"
    return text + (f", {f['cpu_ms_per_frame']:.0f} ms CPU per frame" if f.get("cpu_ms_per_frame") else "")


def markdown_bench(record: dict[str, Any]) -> str:
    """One table a sequence: every run, their median, and the peers' figures."""
    parts, published = [_conditions(record)], tomllib.loads(_PEERS.read_text(encoding="utf-8"))["peer"]
    for name, runs in grouped(record["runs"], "sequence").items():
        peers = [p for p in published if p["sequence"].startswith(name) or p["sequence"].split()[0] in name]
        used = [f for f in FIGURES if f.values(runs) or any(_of_peer(p, f) for p in peers)]
        lines = [[f"edgeslam, seed {run['seed']}", *(f.cell(f.values([run])) for f in used)] for run in runs]
        if len(runs) > 1:
            lines.append([f"**edgeslam, median of {len(runs)}**", *(f.cell(f.values(runs)) for f in used)])
            noise = [f.cell([f.noise(values, values)]) if (values := f.values(runs)) and f.floor else "-" for f in used]
            lines.append(["its noise: two of these differ by less (±)", *noise])
        for k, peer in enumerate(peers, start=1):
            where = "" if peer["sequence"] == name else f", {peer['sequence']}"
            lines.append(
                [
                    f"{peer['system']}{where} [{k}]",
                    *(" ".join(map(f.cell, ([v] for v in _of_peer(peer, f)))) or "-" for f in used),
                ]
            )
        parts += ["", f"### {name}", "", markdown_table(["system", *(f.title for f in used)], lines)]
        errors = [f"- seed {run['seed']} failed: {run['error']}" for run in runs if run.get("error")]
        notes = [f"[{k}] {p['source']}; {p['conditions']}" for k, p in enumerate(peers, start=1)]
        parts += ([""] + errors if errors else []) + ([""] + notes if notes else [])
        stages = {stage: [run["stages"].get(stage, 0.0) for run in runs] for run in runs for stage in run["stages"]}
        means = sorted(((float(np.median(ms)), stage) for stage, ms in stages.items()), reverse=True)
        named = ", ".join(f"{stage} {mean:.2f}" for mean, stage in means if mean >= _SHORTEST_STAGE_MS)
        parts += ["", f"stages, mean ms per frame, median of the runs: {named}"] if named else []
    return "\n".join(parts) + "\n"


def _of_peer(peer: dict[str, Any], figure: Figure) -> list[float]:
    """Published values of a figure, of which a peer may have several."""
    found = peer.get("ate_m" if figure.name == "ate_sim3_m" else figure.name, [])
    return found if isinstance(found, list) else [found]


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
