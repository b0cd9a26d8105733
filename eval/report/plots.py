"""Pictures of a trajectory's error (matplotlib, imported only here)."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.trajectory_error import TrajectoryScore
from edgeslam_torch.files.atomic import write_atomically


def plot_overlay(
    truth: Trajectory, estimates: Sequence[tuple[str, Trajectory, TrajectoryScore]], path: Path | str
) -> None:
    """All trajectories aligned over the truth, from above and from the side, as PNG."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 6), layout="constrained")
    pairs = [score.association.truth for _, _, score in estimates]
    true = truth.positions[slice(min(p.min() for p in pairs), max(p.max() for p in pairs) + 1)]
    for axis, (a, b, names) in zip(axes, ((0, 1, "xy"), (0, 2, "xz")), strict=True):
        axis.plot(true[:, a], true[:, b], color="0.6", lw=3, label="ground truth")
        for name, estimate, score in estimates:
            p = score.alignment.points(estimate.positions)
            axis.plot(p[:, a], p[:, b], lw=1, label=f"{name} ({score.ate_m.rmse:.4f} m)")
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel(f"{names[0]} [m]")
        axis.set_ylabel(f"{names[1]} [m]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    write_atomically(Path(path), lambda file: figure.savefig(file, dpi=110, format="png"))
    plt.close(figure)


def plot_errors(truth: Trajectory, estimate: Trajectory, score: TrajectoryScore, path: Path | str) -> None:
    """Top view, side view and error over time of one run, as PNG."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 7), layout="constrained")
    aligned = score.alignment.poses(estimate.T_w_c)[:, :3, 3]
    true = truth.positions[slice(score.association.truth.min(), score.association.truth.max() + 1)]
    for axis, (a, b, names) in zip(axes[0], ((0, 1, "x y"), (0, 2, "x z")), strict=True):
        axis.plot(true[:, a], true[:, b], color="0.6", lw=1, label="ground truth")
        axis.plot(aligned[:, a], aligned[:, b], color="tab:blue", lw=1, label="estimate")
        axis.set_aspect("equal", adjustable="datalim")
        axis.set_xlabel(f"{names[0]} [m]")
        axis.set_ylabel(f"{names[2]} [m]")
    axes[0, 0].legend(frameon=False)
    time = score.stamps_s - score.stamps_s[0]
    for axis, values, unit in (
        (axes[1, 0], score.error_m, "position error [m]"),
        (axes[1, 1], score.error_deg, "rotation error [deg]"),
    ):
        axis.plot(time, values, color="tab:blue", lw=1)
        axis.axhline(float(np.sqrt(np.mean(values**2))), color="0.5", lw=0.8, ls="--")
        axis.set_xlabel("time [s]")
        axis.set_ylabel(unit)
        axis.set_ylim(bottom=0)
    figure.suptitle(
        f"{score.alignment.kind}: ATE RMSE {score.ate_m.rmse:.4f} m, {score.matched} poses, scale {score.scale:.4f}"
    )
    write_atomically(Path(path), lambda file: figure.savefig(file, dpi=110, format="png"))
    plt.close(figure)
