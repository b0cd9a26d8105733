"""``edgeslam eval``: judge trajectories and maps against ground truth."""

import argparse
import json
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgeslam_torch.errors import ConfigError, EdgeSlamError
from edgeslam_torch.extras import needs_extra
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.output_file import add_overwrite_to, check_new, output_file

if TYPE_CHECKING:
    from edgeslam_torch.eval.metrics.run_score import RunScore
    from edgeslam_torch.eval.metrics.trajectory_error import CommonScore


_PLOT = re.compile(r"\d{2,}_.*\.png|trajectories(_\d{2,})?\.png")
"""Names of the files of ``--plots``."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("runs", nargs="+", type=Path, help="output folders of 'edgeslam run', or trajectory files")
    parser.add_argument(
        "--groundtruth",
        "-g",
        type=Path,
        help="data set folder or trajectory file (TUM, EuRoC, TUM-VI, KITTI, 7-Scenes, or a table that names its "
        "columns; default: that of the recording which the run read)",
    )
    parser.add_argument(
        "--depth-gt", type=Path, help="data set whose depth maps judge the map (default: --groundtruth)"
    )
    parser.add_argument("--max-dt", type=float, default=0.02, help="maximum time between matched poses [s]")
    parser.add_argument("--offset", type=float, default=0.0, help="added to the estimated stamps [s]")
    parser.add_argument(
        "--depth-maps",
        action="store_true",
        help="judge depth maps instead: folders or files (.npy in metres, 16-bit .png), against a recording's folder "
        "(predictions are named after its images) or against maps of the same names",
    )
    parser.add_argument(
        "--images",
        type=Path,
        metavar="DIR",
        help="with --depth-maps: images of the same names, to judge edges alone too",
    )
    parser.add_argument("--depth-unit", type=float, default=5000.0, metavar="N", help="PNG value of a metre (5000)")
    parser.add_argument(
        "--common-frames",
        action="store_true",
        help="also evaluate all of them on their common frames (a system that starts late has fewer)",
    )
    parser.add_argument("--json", type=output_file, help="write all figures here")
    parser.add_argument(
        "--markdown", type=output_file, metavar="FILE", help="write the tables here as Markdown ('-': print it)"
    )
    parser.add_argument(
        "--plots",
        type=Path,
        metavar="DIR",
        help="write a picture of each run's errors into this folder, and one of all trajectories over the truth",
    )
    add_overwrite_to(parser)


def main(args: argparse.Namespace) -> int:
    """Print the tables; 0 when every run could be judged."""
    from edgeslam_torch.eval.metrics.run_score import evaluate_run
    from edgeslam_torch.terminal.progress import counted
    from edgeslam_torch.writers.own_folder import check_pictures

    if args.depth_maps:
        return _depth_maps(args)
    if args.plots is not None:
        check_pictures(args.plots, lambda path: _PLOT.fullmatch(path.name) is not None, "give another --plots")
    scores: list[RunScore] = []
    judged: list[tuple[Path, Path]] = []
    failures: list[str] = []
    for run in counted(args.runs, "judging trajectories and maps", "run"):
        try:
            truth = groundtruth_of(run, args.groundtruth)
            scores.append(evaluate_run(run, truth, args.depth_gt, args.max_dt, args.offset))
            judged.append((run, truth))
        except EdgeSlamError as error:
            if len(args.runs) == 1:
                raise
            failures.append(str(error))
    for failure in failures:
        sys.stderr.write(f"edgeslam: error: {failure}\n")
    if not scores:
        return 1
    scores = _told_apart(scores, [run for run, _ in judged])
    common = _common(args, scores, judged) if args.common_frames and len(scores) > 1 else None
    to_print = args.markdown == Path("-")
    print(_text(scores, common, markdown=to_print))
    if args.markdown is not None and not to_print:
        write_text(args.markdown, _text(scores, common, markdown=True))
    if args.json is not None:
        write_text(args.json, json.dumps([s.to_dict() for s in scores], indent=1, default=str) + "\n")
    if args.plots is not None:
        _plot(args.plots, scores, judged, args.overwrite)
    return 1 if failures else 0


def groundtruth_of(run: Path, given: Path | None) -> Path:
    """The ground truth given, else that of the recording which the run read.

    Raises:
        EvaluationError: If there is none.
    """
    from edgeslam_torch.eval.errors import EvaluationError
    from edgeslam_torch.eval.inputs.run_folder import open_run

    truth = given or open_run(run).own_truth
    if truth is None:
        raise EvaluationError(f"{run}: no ground truth known for it; give --groundtruth FILE or DIR")
    return truth


def _text(scores: "list[RunScore]", common: "list[CommonScore] | None", markdown: bool) -> str:
    from edgeslam_torch.eval.report.tables import common_report, report

    text = report(scores, markdown)
    if common is not None:
        text += "\n" + common_report(common, markdown) + "\n"
    return text + "\n" + _details(scores[0]) if len(scores) == 1 else text


def _told_apart(scores: "list[RunScore]", runs: list[Path]) -> "list[RunScore]":
    """Scores by their paths if folder names are ambiguous."""
    if len({s.name for s in scores}) == len(scores):
        return scores
    return [replace(score, name=str(run)) for score, run in zip(scores, runs, strict=True)]


def _common(args: argparse.Namespace, scores: "list[RunScore]", judged: list[tuple[Path, Path]]) -> "list[CommonScore]":
    from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
    from edgeslam_torch.eval.metrics.trajectory_error import score_common

    truth = one_groundtruth([truth for _, truth in judged])
    estimates = [(s.name, read_trajectory(run)) for s, (run, _) in zip(scores, judged, strict=True)]
    return score_common(read_trajectory(truth), estimates, args.max_dt, args.offset)


def one_groundtruth(truths: list[Path]) -> Path:
    """The ground truth that all have in common.

    Raises:
        EvaluationError: If they have several.
    """
    from edgeslam_torch.eval.errors import EvaluationError

    different = {truth.resolve(): truth for truth in truths}
    if len(different) > 1:
        names = ", ".join(str(truth) for truth in different.values())
        raise EvaluationError(f"runs of different recordings ({names}); give --groundtruth if it is that of all")
    return truths[0]


def _depth_maps(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from edgeslam_torch.eval.metrics.depth_error import TITLES, compare_folders, compare_with_recording
    from edgeslam_torch.eval.report.tables import depth_report

    truth = args.groundtruth
    if truth is None:
        raise ConfigError("--depth-maps needs --groundtruth: a recording's folder, or maps of the same names")
    if (truth / "depth.txt").is_file() or any(truth.glob("*.depth.png")):
        reports = {str(run): compare_with_recording(run, truth) for run in args.runs}
    else:
        reports = {str(run): compare_folders(run, truth, 1.0 / args.depth_unit, args.images) for run in args.runs}
    text = "\n".join(f"{name}\n\n{depth_report(report)}\n" for name, report in reports.items())
    print(text)
    if args.markdown is not None:
        write_text(args.markdown, text)
    if args.json is not None:
        records = {k: {n: asdict(v[n]) if n in v else None for n in TITLES} for k, v in reports.items()}
        write_text(args.json, json.dumps(records, indent=1) + "\n")
    return 0


def _plot(folder: Path, scores: "list[RunScore]", judged: list[tuple[Path, Path]], overwrite: bool) -> None:
    from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory

    with needs_extra("plots", "--plots"):
        from edgeslam_torch.eval.report.plots import plot_errors, plot_overlay

    folder.mkdir(parents=True, exist_ok=True)
    overlays: dict[Path, list[tuple[str, Any, Any]]] = {}
    for number, ((run, place), score) in enumerate(zip(judged, scores, strict=True)):
        estimate = read_trajectory(run)
        assert score.sim3 is not None, "`evaluate_run` gives it"
        overlays.setdefault(place, []).append((score.name, estimate, score.sim3))
        picture = folder / f"{number:02d}_{Path(score.name).name}.png"
        check_new(picture, overwrite, "--plots")
        plot_errors(read_trajectory(place), estimate, score.sim3, picture)
    for number, (place, drawn) in enumerate(overlays.items()):
        name = "trajectories.png" if len(overlays) == 1 else f"trajectories_{number:02d}.png"
        check_new(folder / name, overwrite, "--plots")
        plot_overlay(read_trajectory(place), drawn, folder / name)


def _details(score: Any) -> str:
    """Details that do not fit into the table of one run."""
    found = score.sim3
    lines = [
        f"alignment none {score.ate_raw_m:.4f} m, SE(3) {score.ate_se3_m:.4f} m, Sim(3) {score.ate_sim3_m:.4f} m "
        f"(a fixed position scores {score.fixed_position_m:.3f} m)",
        f"Sim(3): mean {found.ate_m.mean:.6f} median {found.ate_m.median:.6f} std {found.ate_m.std:.6f} "
        f"max {found.ate_m.max:.6f} rmse {found.ate_m.rmse:.6f} m over {found.matched} pairs, "
        f"{found.truth_path_m:.2f} m of path, scale {found.scale:.6f}",
    ]
    if math.isfinite(score.full_transform):
        lines.append(f"full transform (the paper's figure, unitless): {score.full_transform:.4f} rmse")
    for r in (r for r in found.relative if r.pairs):
        lines.append(
            f"RPE over {r.delta}: {r.translation_m.rmse:.4f} m, {r.rotation_deg.rmse:.3f} deg rmse ({r.pairs} pairs)"
        )
    for d in found.drift:
        lines.append(
            f"drift over {d.segment_m:g} m: {d.translation_percent:.2f} %, {d.rotation_deg_per_m:.3f} deg/m "
            f"({d.segments} segments)"
        )
    if score.map is None and score.map_note:
        lines.append(f"map not judged: {score.map_note}")
    return "\n".join(lines) + "\n"
