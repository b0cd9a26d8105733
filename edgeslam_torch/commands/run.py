"""Trajectory and semi-dense edge map from a recording, an image folder, a video or a live camera."""

import argparse
import os
from contextlib import ExitStack
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgeslam_torch.files.output_file import output_file
from edgeslam_torch.help.options import EXIT_INTERRUPTED, add_settings, add_topic, positive_number, say, whole_number

if TYPE_CHECKING:
    from edgeslam_torch.atlas.saved import SavedAtlas
    from edgeslam_torch.config import SlamConfig
    from edgeslam_torch.geometry.camera import Camera
    from edgeslam_torch.readers.source import Source
    from edgeslam_torch.run import RunResult

_MAX_PROBLEMS_SHOWN = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        help="TUM, 7-Scenes, EuRoC or image folder, video file, flight recording, ROS bag, tello://HOST, webcam:N, "
        "rtsp://..., http://..., gst:PIPELINE",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default: runs/NAME, numbered)")
    parser.add_argument(
        "--camera",
        metavar="FILE|PRESET",
        help="calibration file, or tum_fr1, tum_fr2, tum_fr3, tello, kinect (default: the source's own camera.yaml)",
    )
    parser.add_argument(
        "--telemetry", type=Path, metavar="FILE", help="telemetry.csv of the flight (default: SOURCE's own)"
    )
    parser.add_argument(
        "--imu", type=Path, metavar="FILE", help="readings of the IMU, CSV (default: SOURCE's own, such as imu.csv)"
    )
    parser.add_argument("--no-imu", action="store_const", dest="imu", const="none", help="use no IMU")
    parser.add_argument(
        "--imu-model",
        type=Path,
        metavar="FILE",
        help="its noise, mount and clock: imu.yaml, Kalibr's, ORB-SLAM3's (default: beside it)",
    )
    add_topic(parser, "topic of a ROS bag to use, such as /cam0/image_raw or odom=/x (list: edgeslam topics)")
    add_settings(parser)
    parser.add_argument(
        "--mode",
        choices=("offline", "realtime"),
        help="offline: every frame, repeatable; realtime: at camera pace, late frames dropped "
        "(default: offline, realtime for live sources)",
    )
    parser.add_argument(
        "--atlas", type=Path, metavar="FILE", help="fly in the map of an earlier flight, once recognised"
    )
    parser.add_argument(
        "--save-atlas", type=output_file, metavar="FILE", help="save the map for later flights (--atlas)"
    )
    parser.add_argument("--record", type=Path, metavar="DIR", help="record a live source, to run it again")
    parser.add_argument("--lossless", action="store_true", help="record PNG instead of JPEG (quality 95)")
    parser.add_argument("--start", type=whole_number, default=0, metavar="N", help="leave out the first N frames")
    parser.add_argument("--stride", type=positive_number, default=1, metavar="N", help="use every N-th frame")
    parser.add_argument("--max-frames", type=positive_number, metavar="N", help="stop after N frames")
    parser.add_argument("--seed", type=int, help="seed of the robust estimators (default: 0)")
    parser.add_argument(
        "--progress",
        action=argparse.BooleanOptionalAction,
        help="redraw one line (default: when the output is a terminal; a line every few seconds otherwise)",
    )
    parser.add_argument("--viewer", action="store_true", help="watch it in rerun ([viewer] extra)")
    parser.add_argument(
        "--save-rrd", type=output_file, metavar="FILE", help="save the rerun recording to a file instead"
    )
    parser.add_argument(
        "--save-mcap",
        type=output_file,
        metavar="FILE",
        help="save the run as ROS 2 messages, for Foxglove and RViz ([bags] extra)",
    )
    parser.add_argument(
        "--keep-images", action="store_true", help="keep keyframes' images: COLMAP and nerfstudio need files"
    )
    parser.add_argument("--no-report", action="store_true", help="do not write the page report.html")


def main(args: argparse.Namespace) -> int:
    """Run, and print a short summary."""
    from edgeslam_torch.atlas.atlas_file import check_fits, read_atlas
    from edgeslam_torch.errors import ConfigError, OutputError
    from edgeslam_torch.run import AtlasFiles, Listener, Mode, run, settle_camera
    from edgeslam_torch.terminal.run_progress import RunProgress

    if args.lossless and args.record is None:
        raise ConfigError("--lossless is for --record DIR")
    config = resolved_config(args)
    _check_atlas_can_be_saved(args.save_atlas)
    with ExitStack() as files:
        progress = files.enter_context(RunProgress("opening the source", args.progress))
        earlier = None if args.atlas is None else read_atlas(args.atlas)
        source = _source(args)
        if earlier is None or not _take_its_camera(source, earlier):
            settle_camera(source)
        if earlier is not None:
            check_fits(earlier, source.camera, config.orb.scale_factor, args.atlas, config.orb.levels)
        for warning in source.warnings:
            say(f"warning: {warning}")
        say(_camera_words(source.camera))
        mode = Mode(args.mode) if args.mode else (Mode.REALTIME if source.live else Mode.OFFLINE)
        out = args.out if args.out is not None else _new_folder(Path("runs") / source.name)
        if (out / "summary.json").exists():
            say(f"replaces the earlier run in {out}")
        progress.follow(source)
        listeners: list[Listener] = [progress]
        saved = None
        if args.viewer or args.save_rrd is not None:
            from edgeslam_torch.viewer.live_view import LiveView

            listeners.append(LiveView(source.name, source.camera, args.save_rrd))
        if args.keep_images:
            from edgeslam_torch.writers.keyframe_images import FOLDER, KeyframeImages
            from edgeslam_torch.writers.own_folder import check_free

            check_free(out, (FOLDER,))
            listeners.append(KeyframeImages(out))
        if args.save_mcap is not None:
            from edgeslam_torch.readers.pace import ReadingsCursor
            from edgeslam_torch.viewer.mcap_view import McapView

            saved = McapView(source.camera, args.save_mcap, ReadingsCursor(source))
            listeners.append(saved)
            files.callback(saved.close)
        result = run(source, out, config, mode, listeners, atlas=AtlasFiles(earlier, args.save_atlas))
        if not args.no_report and result.failure is None:
            progress.phase("making the report")
            write_page(result)
    _report(result, source)
    if result.failure is not None:
        frames = result.summary["frames"]
        raise OutputError(f"{result.failure}; what the folder holds is valid, up to frame {frames}")
    if saved is not None and saved.failure is not None:
        raise OutputError(f"{saved.failure}; the results in {result.folder} are complete")
    if result.interrupted:
        say(f"interrupted after {result.summary['frames']} frames; results are in {result.folder}")
        return EXIT_INTERRUPTED
    check_tracked(result)
    return 0


def _source(args: argparse.Namespace) -> "Source":
    """The source, the requested part of a recording, or a live source that is recorded."""
    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.readers.source import LIVE_SCHEMES, Recording, open_source

    whole, is_live = args.start == 0 and args.stride == 1, args.source.startswith(LIVE_SCHEMES)
    if is_live and not whole:
        raise ConfigError(f"{args.source}: --start and --stride are for recordings")
    if args.record is not None and not is_live:
        raise ConfigError(f"{args.source}: --record is for live sources ({', '.join(LIVE_SCHEMES)})")
    source = open_source(
        args.source, args.camera, args.telemetry, args.max_frames, args.topic, args.imu, args.imu_model
    )
    if args.record is not None:
        from edgeslam_torch.readers.live import LiveSource
        from edgeslam_torch.writers.tee import RecordedLive

        assert isinstance(source, LiveSource)
        return RecordedLive(source, args.record, args.lossless)
    return source if whole or not isinstance(source, Recording) else source.part(args.start, args.stride)


def _new_folder(folder: Path) -> Path:
    """``runs/NAME``, or ``runs/NAME-2`` and so on beside older runs: none is replaced unless ``--out`` names it."""
    candidates = (folder if number == 1 else folder.with_name(f"{folder.name}-{number}") for number in count(1))
    return next(path for path in candidates if not path.exists() or (path.is_dir() and not any(path.iterdir())))


def _take_its_camera(source: "Source", atlas: "SavedAtlas") -> bool:
    """Give a source of unknown focal length the camera of the atlas, if its images have the same size."""
    camera = source.camera
    if not camera.focal_sigma > atlas.camera.focal_sigma:
        return False
    if (camera.width, camera.height) != (atlas.camera.width, atlas.camera.height):
        return False
    source.camera = replace(atlas.camera, source=f"{atlas.camera.source}, as in the atlas")
    return True


def _check_atlas_can_be_saved(path: Path | None) -> None:
    """Refuse a file that could not be written, or that is no atlas, before the flight and not after it."""
    from edgeslam_torch.errors import OutputError

    if path is None:
        return
    if not path.parent.is_dir():
        raise OutputError(f"{path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise OutputError(f"{path}: cannot write there")
    if path.exists():
        from edgeslam_torch.atlas.atlas_file import is_atlas

        if not is_atlas(path):
            raise OutputError(f"{path}: is not an atlas and is not replaced; give another file to --save-atlas")


def _atlas_words(summary: dict[str, Any]) -> list[str]:
    """What became of the earlier map, and what was saved."""
    lines = []
    earlier, saved = summary["atlas"], summary["saved_atlas"]
    if earlier is not None and earlier["frames_placed"]:
        after = earlier["found_after_s"]
        when = "at the end" if after is None else f"{after:.1f} s after the first frame"
        lines.append(
            f"atlas: recognised {when}; {earlier['frames_placed']} of {summary['frames']} frames lie in it, "
            f"{earlier['keyframes_added']} keyframes added to {earlier['keyframes']}"
        )
    if saved is not None:
        flights = f"{saved['flights']} flight{'s' if saved['flights'] > 1 else ''}"
        lines.append(f"atlas saved: {saved['keyframes']} keyframes, {saved['anchors']} anchors, {flights}")
    return lines


def resolved_config(args: argparse.Namespace) -> "SlamConfig":
    """Defaults overridden by ``--config``, ``--set`` and named options, in this order."""
    from edgeslam_torch.config import SlamConfig
    from edgeslam_torch.errors import ConfigError
    from edgeslam_torch.files.config_file import load_config

    config = load_config(SlamConfig(), args.config, args.set)
    if args.seed is not None:
        try:
            config = replace(config, seed=args.seed)
        except ValueError as error:
            raise ConfigError(f"--seed: {error}") from error
    given = {name: value for name, value in (("weights", args.depth), ("device", args.device)) if value is not None}
    return replace(config, depth=replace(config.depth, **given))


def check_tracked(result: "RunResult") -> None:
    """A run that tracked nothing is no success.

    Raises:
        SourceError: If no frame was tracked.
    """
    from edgeslam_torch.errors import SourceError

    if not result.summary["tracked"]:
        raise SourceError(
            f"no frame was tracked against a map ({result.summary['last_reason'] or 'no reason known'}): the poses in "
            f"{result.folder} are guesses; the camera must move sideways, up or down, and see something with texture"
        )


def write_page(result: "RunResult") -> None:
    """``report.html``; failure to make the page does not fail the run."""
    from edgeslam_torch.errors import EdgeSlamError
    from edgeslam_torch.eval.report.page import write_report

    try:
        write_report(result.folder, judge_map=False)
    except (EdgeSlamError, OSError, ValueError) as error:
        say(f"warning: report.html could not be made ({error})")


def _report(result: "RunResult", source: "Source") -> None:
    summary = result.summary
    scale = summary["scale"]
    for problem in source.problems[:_MAX_PROBLEMS_SHOWN]:
        say(f"{'left out' if problem.frames else 'note'}: {problem.file}: {problem.reason}")
    if len(source.problems) > _MAX_PROBLEMS_SHOWN:
        say(f"left out: {summary['left_out']} in all, listed in {result.folder / 'summary.json'}")
    for warning in summary["warnings"][len(source.warnings) :]:  # the source's warnings were printed before the run
        say(f"warning: {warning}")
    missed = "".join(
        f"; {summary[key]} {words}"
        for key, words in (("left_out", "left out"), ("dropped_frames", "dropped to keep up"))
        if summary[key]
    )
    print(
        f"{summary['tracked']} of {summary['offered']} frames tracked ({100 * summary['coverage']:.1f} %{missed}), "
        f"{_lost_words(summary)}{summary['fps']:.1f} frames/s, "
        f"{summary['cpu_ms_per_frame']:.0f} ms CPU per frame, {summary['peak_rss_mb'] or 0:.0f} MB"
    )
    if scale["units"] == "metres":
        percent = 100.0 * scale["sigma"] / scale["value"]
        print(f"units are metres: scale from {scale['source']}, good to {percent:.1f} % (one sigma)")
    elif summary["map"]["anchors"] == 0:
        print("units are arbitrary: no point was triangulated, so the scale is unknown; did the camera move?")
    else:
        print("units are arbitrary: neither telemetry, an IMU nor a depth network provided the scale")
    counts = summary["map"]
    if counts["edge_points"] == 0:
        say("warning: the edge map is empty")
    print(f"map: {counts['edge_points']} edge points, {counts['anchors']} anchors, {counts['keyframes']} keyframes")
    for line in [*summary["joins"], *summary["loops"], *_atlas_words(summary)]:
        print(line)
    print(f"results: {result.folder} (look at {best_view(result.folder)})")


def _camera_words(camera: "Camera") -> str:
    doubt = f" +- {100 * camera.focal_sigma:.0f} %" if camera.focal_sigma > 0 else ""
    return f"camera: {camera.source}, {camera.width}x{camera.height}, f {camera.fx:.1f} px{doubt}"


def best_view(folder: Path) -> str:
    """What of a run's folder to look at first."""
    return next((name for name in ("report.html", "map.png") if (folder / name).is_file()), "trajectory.txt")


def _lost_words(summary: dict[str, Any]) -> str:
    """How often tracking was lost; empty if there was no tracking."""
    if not summary["tracked"] and not summary["lost_events"]:
        return ""
    count = summary["lost_events"]
    return {0: "never lost, ", 1: "lost once, "}.get(count, f"lost {count} times, ")
