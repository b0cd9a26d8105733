"""Fly a simulated drone through a simulated house, run the pipeline, and compare with the truth."""

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.help.options import EXIT_INTERRUPTED, add_settings, positive_number

if TYPE_CHECKING:
    from edgeslam_torch.demo import DemoResult, DemoSettings


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "--out", type=Path, default=Path("runs/demo"), metavar="DIR", help="results (default: runs/demo)"
    )
    parser.add_argument(
        "--world",
        default="room",
        help="room, corridor or block (once around four corridors; default: room)",
    )
    parser.add_argument("--duration", type=float, metavar="S", help="length of the flight [s] (default: 16; block: 64)")
    parser.add_argument("--seconds", type=float, dest="duration", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    parser.add_argument("--rate", type=float, metavar="HZ", help="images per second (default: 20; block: 15)")
    parser.add_argument(
        "--seed", type=int, default=0, help="another number gives another place and flight (default: 0)"
    )
    parser.add_argument("--images", default="normal", help="camera quality: clean, normal or poor (default: normal)")
    parser.add_argument(
        "--delay", type=float, default=0.5, metavar="S", help="video delay behind telemetry (default: 0.5)"
    )
    parser.add_argument(
        "--loss", type=float, default=0.0, metavar="PERCENT", help="telemetry that is lost (default: 0)"
    )
    parser.add_argument(
        "--battery", type=float, default=87.0, metavar="PERCENT", help="charge at take-off (default: 87)"
    )
    parser.add_argument("--no-telemetry", action="store_true", help="fly without telemetry: no metres from the drone")
    parser.add_argument("--imu", action="store_true", help="carry an IMU (200 Hz, MPU-6050 grade)")
    add_settings(parser)
    parser.add_argument("--record-only", action="store_true", help="only write the simulated recording, to DIR/flight")
    parser.add_argument(
        "--flights",
        type=positive_number,
        metavar="N",
        help="with --record-only: N recordings with seeds from --seed on, to DIR/flight_0000 and so on, for 'batch'",
    )
    parser.add_argument("--width", type=int, default=640, metavar="PX", help="of the images (default: 640)")


def main(args: argparse.Namespace) -> int:
    """Run the demo and print the results."""
    from edgeslam_torch.commands.run import check_tracked, resolved_config, write_page
    from edgeslam_torch.demo import SCORE, record, run_and_judge
    from edgeslam_torch.terminal.run_progress import RunProgress
    from edgeslam_torch.writers.own_folder import check_free
    from edgeslam_torch.writers.run_writer import OUTPUTS

    settings = _settings(args)
    config = resolved_config(args)
    check_free(args.out, () if args.record_only else (*OUTPUTS, SCORE))
    if args.flights is not None:
        return _record_many(args, settings)
    with RunProgress("preparing the flight") as progress:
        progress.phase("rendering the flight", settings.frames, "image")
        recorded = record(args.out / "flight", settings, lambda done: progress.reach(done, settings.frames))
        if args.record_only:
            print(f"recording: {recorded.folder} (try: edgeslam run {recorded.folder})")
            return 0
        progress.phase("loading the system")
        demo = run_and_judge(args.out, recorded, settings, config, [progress])
        progress.phase("making the report")
        write_page(demo.run)
    print(report(demo))
    if demo.run.interrupted:
        return EXIT_INTERRUPTED
    check_tracked(demo.run)
    return 0


def _record_many(args: argparse.Namespace, settings: "DemoSettings") -> int:
    """Flights through different places; those that are there already are left alone."""
    from edgeslam_torch.demo import record
    from edgeslam_torch.errors import ConfigError

    if not args.record_only:
        raise ConfigError("--flights needs --record-only")
    for i in range(args.flights):
        folder = args.out / f"flight_{settings.seed + i:04d}"
        if not (folder / "depth.txt").is_file():  # written last
            record(folder, replace(settings, seed=settings.seed + i))
    print(f"{args.flights} recordings: {args.out} (try: edgeslam batch {args.out} --out {args.out}-batch)")
    return 0


def report(demo: "DemoResult") -> str:
    """The results in a few lines."""
    from edgeslam_torch.commands.run import best_view

    score, summary = demo.score, demo.run.summary
    metres = score.units == "metres"
    scale = "unknown (arbitrary units)" if not metres else f"{100 * score.scale_error:+.1f} % off"
    lines = [
        f"flight:     {summary['frames']} images, {demo.path_m:.1f} m, rendered in {demo.render_s:.0f} s",
        f"tracked:    {100 * score.coverage:.1f} % of the images, first pose at {score.first_pose_s:.2f} s",
        f"trajectory: {100 * score.ate_sim3_m:.1f} cm ATE after Sim(3) ({100 * score.ate_sim3_m / demo.path_m:.2f} % "
        f"of the path)" + (f", {100 * score.ate_se3_m:.1f} cm after SE(3)" if metres else ""),
        f"scale:      {scale}" + (f", from {summary['scale']['source']}" if metres else ""),
    ]
    if demo.map is None:
        lines.append("map:        empty")
    else:
        lines.append(
            f"map:        {demo.map.points} edge points, {100 * demo.map.median_m:.1f} cm from the true surfaces, "
            f"{100 * demo.map.within_5cm:.0f} % within 5 cm"
        )
    lines.append(f"speed:      {summary['fps']:.1f} images/s, {summary['cpu_ms_per_frame']:.0f} ms CPU per image")
    lines.append(f"look at:    {demo.run.folder / best_view(demo.run.folder)}")
    return "\n".join(lines)


def _settings(args: argparse.Namespace) -> "DemoSettings":
    from edgeslam_torch.demo import WORLDS, DemoSettings
    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.synthetic.flights.courses import Course
    from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults

    if args.seed < 0:
        raise ConfigError(f"--seed must not be negative, got {args.seed}")
    if 0 < args.loss < 1:
        raise ConfigError(f"--loss is in percent: {100 * args.loss:g} for a share of {args.loss:g}")
    try:
        faults = TelemetryFaults(video_delay_s=args.delay, loss=args.loss / 100.0, battery_start=args.battery / 100.0)
    except ValueError as error:
        raise ConfigError(f"--loss must lie in [0, 100) and --battery in (0, 100]: {error}") from error
    course = WORLDS.get(args.world, Course())
    seconds = course.seconds if args.duration is None else args.duration
    rate_hz = course.rate_hz if args.rate is None else args.rate
    if not 160 <= args.width <= 1920 or args.width % 4:
        raise ConfigError(f"--width must be 160 to 1920 and a multiple of 4, got {args.width}")
    size = {"width": args.width, "height": args.width * 3 // 4}
    settings = DemoSettings(args.world, seconds, rate_hz, args.seed, args.images, imu=args.imu, **size)
    return replace(settings, telemetry=None if args.no_telemetry else faults)
