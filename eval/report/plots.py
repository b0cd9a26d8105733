"""Pictures of a trajectory's error (matplotlib, imported only here)."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.trajectory_error import TrajectoryScore
from edgeslam_torch.files.atomic import write_atomically


def plot_overlay(
    truth: Trajectory, estimates: Sequence[tuple[str, Trajectory, TrajectoryScore]], path: Path | str
) -> None:
    """All trajectories aligned over the truth, from above and from the side, as PNG."""
    figure, axes = plt.subplots(1, 2, figsize=(12, 6), layout="constrained")
    named = [(f"{name} ({score.ate_m.rmse:.4f} m)", estimate, score) for name, estimate, score in estimates]
    _draw_paths(axes, truth, named)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    _save(figure, path)


def plot_errors(truth: Trajectory, estimate: Trajectory, score: TrajectoryScore, path: Path | str) -> None:
    """Top view, side view and error over time of one run, as PNG."""
    figure, axes = plt.subplots(2, 2, figsize=(10, 7), layout="constrained")
    _draw_paths(axes[0], truth, [("estimate", estimate, score)])
    axes[0, 0].legend(frameon=False)
    errors = {"position error [m]": score.error_m, "rotation error [deg]": score.error_deg}
    for axis, (title, values) in zip(axes[1], errors.items(), strict=True):
        axis.plot(score.stamps_s - score.stamps_s[0], values, lw=1)
        axis.axhline(float(np.sqrt(np.mean(values**2))), color="0.5", lw=0.8, ls="--")
        axis.set(xlabel="time [s]", ylabel=title)
        axis.set_ylim(bottom=0)
    figure.suptitle(
        f"{score.alignment.kind}: ATE RMSE {score.ate_m.rmse:.4f} m, {score.matched} poses, scale {score.scale:.4f}"
    )
    _save(figure, path)


def _draw_paths(
    axes: Sequence[Axes], truth: Trajectory, drawn: Sequence[tuple[str, Trajectory, TrajectoryScore]]
) -> None:
    """The matched part of the truth and the aligned trajectories, in x and y, and in x and z."""
    pairs = [score.pairs[0] for *_, score in drawn]
    true = truth.positions[slice(min(p.min() for p in pairs), max(p.max() for p in pairs) + 1)]
    for axis, k in zip(axes, (1, 2), strict=True):
        axis.plot(true[:, 0], true[:, k], color="0.6", lw=3, label="ground truth")
        for name, estimate, score in drawn:
            p = score.alignment.points(estimate.positions)
            axis.plot(p[:, 0], p[:, k], lw=1, label=name)
        axis.set_aspect("equal", adjustable="datalim")
        axis.set(xlabel="x [m]", ylabel=f"{'xyz'[k]} [m]")


def _save(figure: Figure, path: Path | str) -> None:
    write_atomically(Path(path), lambda file: figure.savefig(file, dpi=110, format="png"))
    plt.close(figure)
