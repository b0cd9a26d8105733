"""``edgeslam calibrate``: camera.yaml from pictures, a video, a bag or a live camera that show a board."""

import argparse
import math
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.files.output_file import output_file
from edgeslam_torch.geometry.camera_file import save_camera

if TYPE_CHECKING:
    import numpy as np

    from edgeslam_torch.calibration.board import Board

_LIVE_GAP_S = 1.0
_RECORDED_GAP_S = 0.5
"""Of each such stretch of a recording the sharpest picture is used."""
_MAX_NAMED = 20
"""Pictures left out that are named one by one."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument(
        "images",
        nargs="+",
        metavar="IMAGES",
        help="pictures, folders of them, a video, a bag, a recording; or tello://HOST, webcam:N",
    )
    parser.add_argument("--board", metavar="COLSxROWS", help="inner corners of a chessboard (default: found by trying)")
    parser.add_argument("--charuco", metavar="COLSxROWS", help="a ChArUco board with so many squares instead")
    parser.add_argument("--aprilgrid", metavar="COLSxROWS", help="an AprilGrid (Kalibr's) with so many tags instead")
    parser.add_argument("--square", type=float, default=25.0, metavar="MM", help="side of a square, or of an AprilTag")
    parser.add_argument("--spacing", type=float, default=0.3, metavar="X", help="AprilGrid: gap / side of a tag")
    parser.add_argument("--marker", type=float, default=18.0, metavar="MM", help="side of a ChArUco marker")
    parser.add_argument("--dictionary", default="DICT_5X5_100", help="of the ChArUco markers (default: DICT_5X5_100)")
    parser.add_argument(
        "--out", type=output_file, default=Path("camera.yaml"), metavar="FILE", help="default: camera.yaml"
    )
    parser.add_argument("--views", type=int, default=25, metavar="N", help="pictures taken from a live camera")


def main(args: argparse.Namespace) -> int:
    """Calibrate, write the file, and print its quality."""
    from edgeslam_torch.calibration.board import Board, calibrate
    from edgeslam_torch.errors import CalibrationError, ConfigError
    from edgeslam_torch.readers.source import LIVE_SCHEMES

    if sum(map(bool, (args.board, args.charuco, args.aprilgrid))) > 1:
        raise ConfigError("give --board, --charuco or --aprilgrid, one of them")
    if args.aprilgrid and not args.spacing > 0:
        raise ConfigError(f"--spacing is the gap between tags relative to their side, such as 0.3, got {args.spacing}")
    columns, rows = _size(args.charuco or args.aprilgrid or args.board)
    spacing = args.spacing if args.aprilgrid else 0.0
    board = Board(columns, rows, args.square / 1e3, bool(args.charuco), args.marker / 1e3, args.dictionary, spacing)
    unreadable: dict[str, str] = {}
    live = args.images[0].startswith(LIVE_SCHEMES)
    if live and len(args.images) > 1:
        raise ConfigError("give one live camera, or pictures")
    pictures = _live_pictures(args.images[0], board, args.views) if live else _pictures(args.images, unreadable)
    try:
        result = calibrate(pictures, board, f"calibrated from {args.images[0]}")
    except CalibrationError as error:
        if not unreadable:
            raise
        name, reason = next(iter(unreadable.items()))
        raise CalibrationError(f"{error}; {len(unreadable)} could not be read (the first: {name}: {reason})") from error
    args.out.parent.mkdir(parents=True, exist_ok=True)
    save_camera(args.out, result.camera)
    camera, sigma = result.camera, result.sigma
    left_out = {**unreadable, **result.rejected}
    for name, reason in list(left_out.items())[:_MAX_NAMED]:
        print(f"left out: {name}: {reason}")
    if len(left_out) > _MAX_NAMED:
        print(f"left out: {len(left_out) - _MAX_NAMED} more")
    for name in ("fx", "fy", "cx", "cy"):
        print(f"{name} {getattr(camera, name):9.3f} +- {sigma[name]:.3f} px")
    print(f"focal length known to {100 * camera.focal_sigma:.2g} %")
    print("distortion " + " ".join(f"{k:.5f}" for k in camera.distortion))
    print(
        f"{len(result.used)} pictures of a {result.board.columns}x{result.board.rows} board, "
        f"reprojection error {result.rms_px:.3f} px RMS, corners in {100 * result.coverage:.0f} % of the picture, "
        f"tilt up to {result.tilt_deg:.0f} degrees"
    )
    for warning in result.warnings:
        print(f"warning: {warning}")
    print(f"written: {args.out}")
    return 0


def _size(text: str | None) -> tuple[int, int]:
    from edgeslam_torch.errors import ConfigError

    if text is None:
        return 0, 0
    match = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", text)
    if match is None:
        raise ConfigError(f"a board's size is COLUMNSxROWS, such as 8x6, got {text!r}")
    return int(match[1]), int(match[2])


def _pictures(names: list[str], unreadable: dict[str, str]) -> "Iterator[tuple[str, np.ndarray]]":
    import cv2

    from edgeslam_torch.errors import SourceError
    from edgeslam_torch.readers.images import SUFFIXES, image_files, read_pixels

    for name in names:
        path = Path(name).expanduser()
        if not path.exists():
            raise SourceError(f"{path}: no such picture, folder or recording")
        files = [path] if path.suffix.lower() in SUFFIXES else image_files(path) if path.is_dir() else []
        if not files:
            yield from _recorded_pictures(path, unreadable)
        for file in files:
            try:
                yield str(file), read_pixels(file, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
            except SourceError as error:
                unreadable[str(file)] = str(error).removeprefix(f"{file}: ")


def _recorded_pictures(path: Path, unreadable: dict[str, str]) -> "Iterator[tuple[str, np.ndarray]]":
    """The sharpest picture of each half second of a video, bag or recording."""
    import cv2

    from edgeslam_torch.frontend.image import as_grey
    from edgeslam_torch.readers.listing import Problem
    from edgeslam_torch.readers.source import frames_without_camera

    problems: list[Problem] = []
    best: tuple[float, str, np.ndarray] | None = None
    until_s = -math.inf
    for frame in frames_without_camera(path, problems):
        grey = as_grey(frame.image)
        sharpness = float(cv2.Laplacian(grey, cv2.CV_16S).var())
        if frame.stamp_s >= until_s:
            if best is not None:
                yield best[1:]
            best, until_s = None, frame.stamp_s + _RECORDED_GAP_S
        if best is None or sharpness > best[0]:
            best = sharpness, f"{path.name}, frame {frame.index}", grey
    if best is not None:
        yield best[1:]
    unreadable |= {problem.file: problem.reason for problem in problems if problem.frames}


def _live_pictures(spec: str, board: "Board", views: int) -> "Iterator[tuple[str, np.ndarray]]":
    """Pictures with a visible board, a second apart; prints what the user should change."""
    from edgeslam_torch.calibration.board import board_size, find_board
    from edgeslam_torch.frontend.image import as_grey
    from edgeslam_torch.readers.live import open_live

    source = open_live(spec, "tello" if spec.startswith("tello://") else None)
    taken, last_s = 0, 0.0
    try:
        for frame in source.frames():
            if time.monotonic() - last_s < _LIVE_GAP_S:
                continue
            grey = as_grey(frame.image)
            seen = board_size([grey]) if board.columns == 0 else find_board("", grey, board)
            if seen is None:
                continue
            taken, last_s = taken + 1, time.monotonic()
            print(f"picture {taken} of {views}: now hold the board elsewhere, and tilted", flush=True)
            yield f"picture {taken}", grey
            if taken >= views:
                return
    finally:
        source.close()
