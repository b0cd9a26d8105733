"""Metric depth of images, folders and videos."""

import argparse
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edgeslam_torch.errors import ConfigError, OutputError
from edgeslam_torch.files.output_file import add_overwrite_to, check_new
from edgeslam_torch.help.options import positive_number

if TYPE_CHECKING:
    from edgeslam_torch.geometry.camera import Camera
    from edgeslam_torch.readers.listing import Problem
    from edgeslam_torch.types import DepthMap, Frame

FILES = """\
files written for every image STEM.jpg, pixel for pixel, lens distortion removed:
  STEM.npy         depth along the optical axis in metres, float32; NaN where unknown
  STEM.png         the same in millimetres, 16 bit; 0 where nothing is known, 65535 for 65.5 m and beyond
  STEM_colour.png  to look at: near is red, far is blue, unknown is black; the bar below shows the metres
  STEM_sigma.npy   with --sigma: standard deviation of the logarithm of depth, float32; 0.1 is about 10 %
"""
MAX_MILLIMETRES = 65535
_MAX_PROBLEMS_SHOWN = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "\n".join(filter(None, (FILES, parser.epilog)))
    parser.add_argument("source", metavar="SOURCE", help="an image, a folder, a recording or a video")
    parser.add_argument("--out", "-o", type=Path, metavar="DIR", required=True, help="folder for the files below")
    parser.add_argument(
        "--camera", metavar="FILE|PRESET", help="calibration (default: the source's own camera.yaml); metres follow it"
    )
    parser.add_argument(
        "--depth", default="default", metavar="FILE|NAME", help="weights, near, an ONNX file or a downloaded network"
    )
    parser.add_argument("--weights", dest="depth", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    parser.add_argument("--backend", choices=("onnxruntime", "torch"), default="onnxruntime", help="what runs it")
    parser.add_argument(
        "--device",
        choices=("auto", "cpu", "cuda", "mps"),
        default="cpu",
        help="where it runs (default: cpu; auto: the fastest that is there)",
    )
    parser.add_argument("--threads", type=positive_number, default=1, metavar="N", help="threads of one inference")
    parser.add_argument("--max-frames", type=positive_number, metavar="N", help="stop after N images")
    add_overwrite_to(parser)
    parser.add_argument("--sigma", action="store_true", help="write STEM_sigma.npy, too")


def main(args: argparse.Namespace) -> int:
    """Write ``STEM.npy`` (float32 metres), ``STEM.png`` (16-bit millimetres) and ``STEM_colour.png`` per
    image."""
    from edgeslam_torch.frontend.depth_check import MIN_SHARE, CheckedDepth
    from edgeslam_torch.frontend.depth_network import open_depth, weights_path
    from edgeslam_torch.terminal.progress import counted
    from edgeslam_torch.writers.own_folder import check_pictures

    check_pictures(args.out, _is_depth, "give another folder to --out")
    network = open_depth(weights_path(args.depth), args.backend, args.threads, args.device)
    if not network.is_metric:
        raise ConfigError(f"{network.weights}: gives depth up to scale and shift; a map has both: edgeslam run --depth")
    camera, frames, length, warnings, problems = _frames(args.source, args.camera, args.max_frames)
    for warning in warnings:
        print(f"note: {warning}")
    checked, contradiction = CheckedDepth(network), ""
    shares: list[float] = []
    stems: set[str] = set()
    args.out.mkdir(parents=True, exist_ok=True)
    for frame in counted(frames, "depth", "image", length):
        _spare_the_source(args.out, frame.path)
        image = np.asarray(camera.undistort_image(frame.image), np.uint8)
        depth = network(image, camera)
        contradiction = checked.contradiction(depth, image, camera)
        depth, share = _believable(depth)
        shares.append(share)
        stem = _stem(frame, stems)
        for name in _names(stem, args.sigma):
            check_new(args.out / name, args.overwrite)
        write_depth(args.out, stem, depth, args.sigma)
    for problem in problems[:_MAX_PROBLEMS_SHOWN]:
        print(f"{'left out' if problem.frames else 'note'}: {problem.file}: {problem.reason}")
    if len(problems) > _MAX_PROBLEMS_SHOWN:
        print(f"left out: {sum(problem.frames for problem in problems)} in all")
    unknown = sum(share < MIN_SHARE for share in shares)
    if unknown:
        print(f"note: {unknown} of {len(shares)} depth maps are mostly unknown: these weights do not fit these images")
    if contradiction:
        print(f"warning: {contradiction}: are these maps in metres?")
    lens = ", lens distortion removed" if camera.is_distorted else ""
    print(f"{len(shares)} depth maps in {args.out} (metres for {camera.source}{lens}; {network.backend})")
    return 0


def write_depth(folder: Path, stem: str, depth: "DepthMap", with_sigma: bool = False) -> None:
    """Write one depth map as numbers, as millimetres and as colours.

    Raises:
        OSError: If a file cannot be written.
    """
    from edgeslam_torch.files.atomic import write_atomically
    from edgeslam_torch.files.plain import write_image
    from edgeslam_torch.writers.depth_picture import colour

    write_atomically(folder / f"{stem}.npy", lambda file: np.save(file, depth.depth_m))
    millimetres = np.clip(np.nan_to_num(depth.depth_m) * 1000.0 + 0.5, 0, MAX_MILLIMETRES).astype(np.uint16)
    for name, image in ((f"{stem}.png", millimetres), (f"{stem}_colour.png", colour(depth.depth_m))):
        write_image(folder / name, image)
    if with_sigma:
        write_atomically(folder / f"{stem}_sigma.npy", lambda file: np.save(file, depth.sigma_log))


def _is_depth(path: Path) -> bool:
    """Whether a picture is one of a depth map's."""
    return path.with_name(f"{path.stem.removesuffix('_colour')}.npy").is_file()


def _names(stem: str, with_sigma: bool) -> list[str]:
    names = [f"{stem}.npy", f"{stem}.png", f"{stem}_colour.png"]
    return [*names, f"{stem}_sigma.npy"] if with_sigma else names


def _believable(depth: "DepthMap") -> "tuple[DepthMap, float]":
    """The map with NaN at implausible pixels, and the share of plausible ones."""
    from edgeslam_torch.frontend.depth_check import usable

    good = usable(depth)
    return replace(depth, depth_m=np.where(good, depth.depth_m, np.float32(np.nan))), float(good.mean())


def _spare_the_source(out: Path, image: Path | None) -> None:
    """Refuse to write depth maps beside the images: ``STEM.png`` would overwrite them."""
    if image is not None and out.resolve() == image.resolve().parent:
        raise OutputError(f"{out}: holds the images themselves, which depth maps of the same names would overwrite")


def _stem(frame: "Frame", taken: set[str]) -> str:
    """Stem of an image's output files; includes the suffix if another image has the same stem."""
    if frame.path is None:
        return f"frame_{frame.index:06d}"
    stem = frame.path.stem if frame.path.stem not in taken else frame.path.name
    taken.add(stem)
    return stem


def _frames(
    source: str, camera: str | None, max_frames: int | None
) -> "tuple[Camera, Iterable[Frame], int | None, list[str], list[Problem]]":
    """Camera, images, their number, warnings, and the list that unreadable images are added to."""
    from edgeslam_torch.calibration.camera_choice import choose_camera
    from edgeslam_torch.readers.images import SUFFIXES, read_image
    from edgeslam_torch.readers.source import open_source
    from edgeslam_torch.types import Frame

    path = Path(source)
    if path.suffix.lower() in SUFFIXES:
        image = read_image(path)
        size = (image.shape[1], image.shape[0])
        chosen, warnings = choose_camera(size, camera, [path.parent, path.absolute().parent.parent])
        return chosen, [Frame(0, 0.0, image, path)], 1, warnings, []
    opened = open_source(source, camera, max_frames=max_frames)
    return opened.camera, opened.frames(), opened.length, opened.warnings, opened.problems
