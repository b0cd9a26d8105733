"""Metric scale on real images: telemetry simulated along a recording's ground truth, processed by the whole pipeline.

The state messages are those of a Tello (10 Hz, whole dm/s, degrees and centimetres, drift that grows as the battery
drains), half a second ahead of the video. Outages test runs whose telemetry stops or repeats::

    python -m edgeslam_torch.eval.benchmark.telemetry_runs data/tum_fr1_xyz data/7scenes_redkitchen --seeds 5
"""

import argparse
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
from edgeslam_torch.eval.metrics.run_score import evaluate_run
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.run import run
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, TelemetryLog, simulate

OUTAGE_S = 10.0


class Outage(StrEnum):
    """What happens to the telemetry in the middle of the flight, for ten seconds."""

    NONE = "none"
    OFF = "off"
    FROZEN = "frozen"
    """The last message is repeated."""


@dataclass(frozen=True, slots=True)
class TelemetryRun:
    """Result of one run."""

    sequence: str
    seed: int
    outage: Outage
    scale_error: float
    """Relative."""
    sigma: float
    """Stated, relative."""
    ate_se3_m: float
    ate_sim3_m: float
    coverage: float
    source: str

    def line(self) -> str:
        """For the terminal."""
        inside = abs(self.scale_error) / self.sigma if self.sigma > 0 else float("nan")
        return (
            f"{self.sequence:20s} seed {self.seed} telemetry {self.outage:6s}: scale {100 * self.scale_error:+.2f} % "
            f"(stated sigma {100 * self.sigma:.2f} %, {inside:.1f} of it), ATE SE(3) {self.ate_se3_m:.4f} m, "
            f"Sim(3) {self.ate_sim3_m:.4f} m, {100 * self.coverage:.1f} % of frames, from {self.source}"
        )


def telemetry_of(sequence: Path, stamps_s: Sequence[float], seed: int, outage: Outage = Outage.NONE) -> TelemetryLog:
    """State messages along a recording's ground truth.

    Args:
        sequence: Folder with ``groundtruth.txt`` in a world whose z axis points up.
        stamps_s: First and last frame.
        seed: Of the noise.
        outage: What happens in the middle.
    """
    truth = read_trajectory(sequence / "groundtruth.txt")
    near = (truth.stamps_s >= stamps_s[0] - 1.0) & (truth.stamps_s <= stamps_s[-1] + 1.0)
    middle = 0.5 * (stamps_s[0] + stamps_s[-1])
    gap = (middle - 0.5 * OUTAGE_S, middle + 0.5 * OUTAGE_S)
    faults = TelemetryFaults(outages_s=(gap,) if outage is Outage.OFF else ())
    log = simulate(
        np.random.default_rng(seed), truth.stamps_s[near], truth.T_w_c[near], camera_on_body(), faults=faults
    )
    if outage is Outage.FROZEN:
        stuck = (log.stamps_s >= gap[0]) & (log.stamps_s < gap[1])
        rows = log.rows.copy()
        rows[stuck] = rows[int(np.argmax(stuck))]
        log = replace(log, rows=rows)
    return log


def fly(
    sequence: Path, out: Path, seed: int, outage: Outage = Outage.NONE, config: SlamConfig | None = None
) -> TelemetryRun:
    """Synthesise, run, judge; as ``edgeslam run SEQUENCE --telemetry FILE``."""
    out.mkdir(parents=True, exist_ok=True)
    source = open_source(sequence)
    stamps = [frame.stamp_s for frame in source.frames()]
    telemetry = out / "telemetry.csv"
    telemetry_of(sequence, stamps, seed, outage).write(telemetry)
    result = run(open_source(sequence, telemetry=telemetry), out / "run", config or SlamConfig())
    score = evaluate_run(result.folder, sequence, judge_map=False)
    scale = result.summary["scale"]
    error = 1.0 / (1.0 + score.scale_error) - 1.0  # error of the estimate, not of the correction factor
    sigma = scale["sigma"] / scale["value"]
    return TelemetryRun(
        sequence.name, seed, outage, error, sigma, score.ate_se3_m, score.ate_sim3_m, score.coverage, scale["source"]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Print one line a run and the worst of each sequence."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("sequence", nargs="+", type=Path)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--outage", action="append", choices=[str(o) for o in Outage], default=[])
    args = parser.parse_args(arguments)
    for sequence in args.sequence:
        runs = []
        for outage in args.outage or ["none"]:
            for seed in range(args.seeds):
                with tempfile.TemporaryDirectory() as folder:
                    runs.append(fly(sequence, Path(folder), seed, Outage(outage)))
                sys.stdout.write(runs[-1].line() + "\n")
                sys.stdout.flush()
        worst = max(abs(r.scale_error) for r in runs)
        ate = max(r.ate_se3_m for r in runs)
        sys.stdout.write(f"{sequence.name}: worst scale error {100 * worst:.2f} %, worst ATE SE(3) {ate:.4f} m\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
