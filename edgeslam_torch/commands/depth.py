"""``edgeslam depth``: metric depth of images, folders and videos."""

import argparse
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edgeslam_torch.errors import OutputError

if TYPE_CHECKING:
    from edgeslam_torch.geometry.camera import Camera
    from edgeslam_torch.types import DepthMap, Frame

HELP = "metric depth of images, a folder or a video"

MAX_MILLIMETRES = 65535


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("source", help="an image, a folder, a recording or a video")
    parser.add_argument("--out", "-o", type=Path, required=True, help="folder for the results")
    parser.add_argument("--camera", help="calibration file or preset (found by itself where the source has one)")
    parser.add_argument("--weights", type=Path, help="weights (.safetensors) or an exported model (.onnx)")
    parser.add_argument("--backend", choices=("onnxruntime", "torch"), default="onnxruntime")
    parser.add_argument("--threads", type=int, default=1, help="threads of one inference")
    parser.add_argument("--max-frames", type=int, help="stop after this many images")
    parser.add_argument(
        "--sigma", action="store_true", help="also write STEM_sigma.npy: standard deviation of log depth"
    )


def main(args: argparse.Namespace) -> int:
    """Write ``STEM.npy`` (float32 metres), ``STEM.png`` (16-bit millimetres) and ``STEM_colour.png`` per
    image."""
    from tqdm import tqdm

    from edgeslam_torch.frontend.depth import DepthPredictor

    predictor = DepthPredictor(args.weights, args.backend, args.threads)
    camera, frames, length, warnings = _frames(args.source, args.camera, args.max_frames)
    for warning in warnings:
        print(f"note: {warning}")
    args.out.mkdir(parents=True, exist_ok=True)
    count = 0
    for frame in tqdm(frames, total=length, unit="image", disable=None):
        depth = predictor(np.asarray(camera.undistort_image(frame.image), np.uint8), camera)
        stem = frame.path.stem if frame.path is not None else f"frame_{frame.index:06d}"
        try:
            write_depth(args.out, stem, depth, args.sigma)
        except OSError as error:
            raise OutputError(f"{args.out}/{stem}: cannot be written ({error.strerror})") from error
        count += 1
    lens = ", lens distortion removed" if camera.is_distorted else ""
    print(f"{count} depth maps in {args.out} (metres for {camera.source}{lens}; {predictor.backend})")
    return 0


def write_depth(folder: Path, stem: str, depth: "DepthMap", with_sigma: bool = False) -> None:
    """Write one depth map as numbers, as millimetres and as colours.

    Raises:
        OSError: If a file cannot be written.
    """
    import cv2

    np.save(folder / f"{stem}.npy", depth.depth_m)
    millimetres = np.clip(np.nan_to_num(depth.depth_m) * 1000.0 + 0.5, 0, MAX_MILLIMETRES).astype(np.uint16)
    for name, image in ((f"{stem}.png", millimetres), (f"{stem}_colour.png", colour(depth.depth_m))):
        if not cv2.imwrite(str(folder / name), image):
            raise OSError(0, "OpenCV could not write the image", str(folder / name))
    if with_sigma:
        np.save(folder / f"{stem}_sigma.npy", depth.sigma_log)


def colour(depth_m: np.ndarray) -> np.ndarray:
    """Inverse depth as colours, near red and far blue, ``(H, W, 3)`` BGR; unknown depth is black."""
    import cv2

    known = np.isfinite(depth_m) & (depth_m > 0)
    inverse = np.zeros(depth_m.shape, np.float32)
    inverse[known] = 1.0 / depth_m[known]
    low, high = np.percentile(inverse[known], (2, 98)) if known.any() else (0.0, 1.0)
    level = np.clip((inverse - low) / max(high - low, 1e-6) * 255.0, 0, 255).astype(np.uint8)
    picture = np.asarray(cv2.applyColorMap(level, cv2.COLORMAP_TURBO))
    picture[~known] = 0
    return picture


def _frames(
    source: str, camera: str | None, max_frames: int | None
) -> "tuple[Camera, Iterable[Frame], int | None, list[str]]":
    from edgeslam_torch.io.camera_choice import choose_camera
    from edgeslam_torch.io.images import SUFFIXES, read_image
    from edgeslam_torch.io.source import open_source
    from edgeslam_torch.types import Frame

    path = Path(source)
    if path.suffix.lower() in SUFFIXES:
        image = read_image(path)
        size = (image.shape[1], image.shape[0])
        chosen, warnings = choose_camera(size, camera, [path.parent, path.absolute().parent.parent])
        return chosen, [Frame(0, 0.0, image, path)], 1, warnings
    opened = open_source(source, camera, max_frames=max_frames)
    return opened.camera, opened.frames(), opened.length, opened.warnings
