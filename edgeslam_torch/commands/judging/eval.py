"""``edgeslam eval``: judge trajectories and maps against ground truth."""

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgeslam_torch.errors import EdgeSlamError, OutputError
from edgeslam_torch.extras import needs_extra

if TYPE_CHECKING:
    from edgeslam_torch.eval.metrics.run_score import RunScore


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("runs", nargs="+", type=Path, help="output folders of 'edgeslam run', or trajectory files")
    parser.add_argument(
        "--groundtruth",
        "-g",
        type=Path,
        required=True,
        help="data set folder or trajectory file (TUM, EuRoC, KITTI, 7-Scenes)",
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
    parser.add_argument("--json", type=Path, help="write all figures here")
    parser.add_argument("--markdown", type=Path, help="write the tables here")
    parser.add_argument("--plots", type=Path, help="write one picture per run into this folder")
    parser.add_argument(
        "--convert",
        nargs=2,
        metavar=("FORMAT", "PATH"),
        help="also write the (first) trajectory as tum, euroc, kitti or 7scenes",
    )


def main(args: argparse.Namespace) -> int:
    """Print the tables; 0 when every run could be judged."""
    from edgeslam_torch.eval.metrics.run_score import evaluate_run
    from edgeslam_torch.eval.report.tables import markdown_report

    if args.depth_maps:
        return _depth_maps(args)
    scores: list[RunScore] = []
    judged: list[Path] = []
    failures: list[str] = []
    for run in args.runs:
        try:
            scores.append(evaluate_run(run, args.groundtruth, args.depth_gt, args.max_dt, args.offset))
            judged.append(run)
        except EdgeSlamError as error:
            if len(args.runs) == 1:
                raise
            failures.append(str(error))
    for failure in failures:
        sys.stderr.write(f"edgeslam: error: {failure}\n")
    if not scores:
        return 1
    args.runs = judged
    scores = _told_apart(scores, judged)
    report = markdown_report(scores)
    if args.common_frames and len(scores) > 1:
        report += "\n" + _common(args, scores) + "\n"
    if len(scores) == 1:
        report += "\n" + _details(scores[0])
    print(report)
    try:
        _write_files(args, scores, report)
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be written ({error.strerror})") from error
    return 1 if failures else 0


def _told_apart(scores: "list[RunScore]", runs: list[Path]) -> "list[RunScore]":
    """Scores by their paths if folder names are ambiguous."""
    if len({s.name for s in scores}) == len(scores):
        return scores
    return [replace(score, name=str(run)) for score, run in zip(scores, runs, strict=True)]


def _common(args: argparse.Namespace, scores: "list[RunScore]") -> str:
    from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory
    from edgeslam_torch.eval.metrics.common_frames import markdown_common, score_common

    estimates = [(s.name, read_trajectory(run)) for s, run in zip(scores, args.runs, strict=True)]
    return markdown_common(score_common(read_trajectory(args.groundtruth), estimates, args.max_dt, args.offset))


def _depth_maps(args: argparse.Namespace) -> int:
    from dataclasses import asdict

    from edgeslam_torch.eval.metrics.depth_error import compare_folders, compare_with_recording, markdown_depth

    truth = args.groundtruth
    if (truth / "depth.txt").is_file() or any(truth.glob("*.depth.png")):
        reports = {str(run): compare_with_recording(run, truth) for run in args.runs}
    else:
        reports = {str(run): compare_folders(run, truth, 1.0 / args.depth_unit, args.images) for run in args.runs}
    text = "\n".join(f"{name}\n\n{markdown_depth(report)}\n" for name, report in reports.items())
    print(text)
    try:
        if args.markdown is not None:
            args.markdown.write_text(text, encoding="utf-8")
        if args.json is not None:
            args.json.write_text(json.dumps({k: asdict(v) for k, v in reports.items()}, indent=1) + "\n")
    except OSError as error:
        raise OutputError(f"{error.filename}: cannot be written ({error.strerror})") from error
    return 0


def _write_files(args: argparse.Namespace, scores: list[Any], report: str) -> None:
    from edgeslam_torch.eval.inputs.trajectory_files import WRITERS, read_trajectory

    if args.markdown is not None:
        args.markdown.write_text(report, encoding="utf-8")
    if args.json is not None:
        args.json.write_text(json.dumps([s.to_dict() for s in scores], indent=1, default=str) + "\n", encoding="utf-8")
    if args.plots is not None:
        _plot(args.plots, args, scores)
    if args.convert is not None:
        name, target = args.convert
        if name not in WRITERS:
            raise OutputError(f"--convert {name}: known formats are {', '.join(WRITERS)}")
        WRITERS[name](read_trajectory(args.runs[0]), target)


def _plot(folder: Path, args: argparse.Namespace, scores: list[Any]) -> None:
    from edgeslam_torch.eval.inputs.trajectory_files import read_trajectory

    with needs_extra("plots", "--plots"):
        from edgeslam_torch.eval.report.plots import plot_errors

    folder.mkdir(parents=True, exist_ok=True)
    truth = read_trajectory(args.groundtruth)
    for number, (run, score) in enumerate(zip(args.runs, scores, strict=True)):
        if score.sim3 is not None:
            plot_errors(truth, read_trajectory(run), score.sim3, folder / f"{number:02d}_{score.name}.png")


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
    for r in found.relative:
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
