"""Export the depth network to ONNX, verified and timed."""

import argparse
import importlib
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from edgeslam_torch.errors import ConfigError, OutputError
from edgeslam_torch.extras import needs_extra
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.files.output_file import output_file

if TYPE_CHECKING:
    from torch import nn

    from edgeslam_torch.models.record import Metadata
    from edgeslam_torch.terminal.progress import Progress
    from edgeslam_torch.types import FloatArray

PARITY_RTOL = 1e-4
"""Maximum relative difference of depth between torch and onnxruntime in float32."""
CALIBRATION_IMAGES = 96
CHECK_IMAGES = 16
TIMED_RUNS = 40


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's options."""
    parser.add_argument("--depth", default="default", metavar="FILE|NAME", help="weights to export (default: default)")
    parser.add_argument("depth", nargs="?", default=argparse.SUPPRESS, help=argparse.SUPPRESS)  # as in version 0.2
    parser.add_argument("--out", "-o", type=output_file, required=True, help="ONNX file to write")
    parser.add_argument("--int8", action="store_true", help="static int8 quantisation; needs --calibrate")
    parser.add_argument("--fp16", action="store_true", help="store weights as float16")
    parser.add_argument("--calibrate", help="images, recording or video like those it will see")
    parser.add_argument("--size", metavar="HxW", help="input size, multiples of 32 (default: as trained)")
    parser.add_argument("--dynamic-size", action="store_true", help="any height and width, multiples of 32; slower")
    parser.add_argument("--dynamic-batch", action="store_true", help="any number of images at a time")
    parser.add_argument("--opset", type=int, default=18, help="ONNX operator set (default: 18)")
    parser.add_argument(
        "--old-runtime", action="store_true", help="for onnxruntime before 1.17: opset 17 and IR version 9"
    )


def main(args: argparse.Namespace) -> int:
    """Export, compare with torch on real frames, print the table."""
    from edgeslam_torch.terminal.progress import Progress

    with Progress("loading") as progress:
        return _export(args, progress)


def _export(args: argparse.Namespace, progress: "Progress") -> int:
    with needs_extra("export", "edgeslam export"):
        importlib.import_module("onnxscript")  # torch loads it when it exports, and fails in many words
    from edgeslam_torch.frontend.depth_network import weights_path
    from edgeslam_torch.models.checkpoint import load_checkpoint
    from edgeslam_torch.models.onnx.export import OLD_RUNTIME_OPSET, ExportOptions, export_onnx
    from edgeslam_torch.models.onnx.fold import deployed
    from edgeslam_torch.models.onnx.quantize import MIN_CALIBRATION_IMAGES, quantize_int8, store_float16
    from edgeslam_torch.terminal.progress import counted

    if args.int8 and args.fp16:
        raise ConfigError("--int8 and --fp16 exclude each other")
    if args.int8 and args.calibrate is None:
        raise ConfigError("--int8 needs --calibrate DATA: real frames like those the network will see")
    network, metadata = load_checkpoint(weights_path(args.depth))
    height, width = _size(args.size, metadata)
    opset = _opset(min(args.opset, OLD_RUNTIME_OPSET) if args.old_runtime else args.opset)
    images = list(counted(_images(args.calibrate, height, width, metadata), "reading", "image"))
    if args.int8 and len(images) < MIN_CALIBRATION_IMAGES:
        raise ConfigError(f"{args.calibrate}: --int8 needs {MIN_CALIBRATION_IMAGES} images, there are {len(images)}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as folder:
        progress.phase("exporting")
        plain = Path(folder) / "float32.onnx"
        options = ExportOptions(height, width, opset, args.dynamic_size, args.dynamic_batch)
        export_onnx(network, metadata, plain, options)
        models = {"float32": _Model(plain)}
        progress.phase("comparing with torch")
        _require_parity(models["float32"], deployed(network, metadata), images[:CHECK_IMAGES])
        target = plain
        if args.int8 or args.fp16:
            progress.phase(f"quantising, calibrated on {len(images)} images" if args.int8 else "storing float16")
            target = Path(folder) / "target.onnx"
            if args.int8:
                quantize_int8(plain, target, images)
            else:
                store_float16(plain, target)
            models["int8" if args.int8 else "float16"] = _Model(target)
        progress.phase("timing")
        print(_table(models, images[:CHECK_IMAGES]))
        write_atomically(args.out, lambda file: file.write(target.read_bytes()))
    size = "any size in multiples of 32" if args.dynamic_size else f"{height}x{width}"
    batch = ", any batch" if args.dynamic_batch else ""
    print(f"{args.out}: {size}{batch}, opset {opset}, focal length {metadata.focal_px:.1f} px in the input")
    return 0


def _size(text: str | None, metadata: "Metadata") -> tuple[int, int]:
    from edgeslam_torch.models.layout import INPUT_MULTIPLE
    from edgeslam_torch.models.record import MAX_INPUT_PX

    if text is None:
        return metadata.input_height, metadata.input_width
    try:
        height, width = (int(n) for n in text.lower().split("x"))
    except ValueError:
        raise ConfigError(f"--size {text}: expected HEIGHTxWIDTH, for example 192x256") from None
    sides = (height, width)
    if any(side % INPUT_MULTIPLE or not INPUT_MULTIPLE <= side <= MAX_INPUT_PX for side in sides):
        raise ConfigError(f"--size {text}: height and width must be multiples of {INPUT_MULTIPLE} up to {MAX_INPUT_PX}")
    return height, width


def _opset(wanted: int) -> int:
    import onnx

    from edgeslam_torch.models.onnx.export import OLDEST_OPSET

    newest = onnx.defs.onnx_opset_version()
    if not OLDEST_OPSET <= wanted <= newest:
        raise ConfigError(f"--opset {wanted}: must be from {OLDEST_OPSET} to {newest}")
    return wanted


def _images(source: str | None, height: int, width: int, metadata: "Metadata") -> "Iterator[FloatArray]":
    """Preprocessed frames, spread evenly over the source; noise-free ramps when there is none."""
    from edgeslam_torch.frontend.network_input import preprocess

    if source is None:
        ramp = np.linspace(0, 255, 640 * 480 * 3).reshape(480, 640, 3).astype(np.uint8)
        flips = (ramp, np.ascontiguousarray(ramp[::-1]), np.ascontiguousarray(ramp[:, ::-1]))
        yield from (preprocess(image, height, width, metadata) for image in flips)
        return
    from edgeslam_torch.readers.source import open_source

    opened = open_source(source)
    step = max((opened.length or CALIBRATION_IMAGES) // CALIBRATION_IMAGES, 1)
    kept = (f for i, f in enumerate(opened.frames()) if i % step == 0)
    undistorted = (np.asarray(opened.camera.undistort_image(f.image), np.uint8) for f in kept)
    yield from (preprocess(image, height, width, metadata) for image in undistorted)


def _require_parity(model: "_Model", module: "nn.Module", images: "list[FloatArray]") -> None:
    """Raise OutputError unless onnxruntime gives torch's depth."""
    import torch

    for image in images:
        with torch.no_grad():
            expected = module(torch.from_numpy(image))[0].numpy()
        worst = float(np.abs(np.exp(model.log_depth(image) - expected) - 1).max())
        if worst > PARITY_RTOL:
            raise OutputError(f"exported depth differs from torch by {worst:.1e} (limit {PARITY_RTOL:.0e})")


def _table(models: "dict[str, _Model]", images: "list[FloatArray]") -> str:
    lines = [
        "| model | MB | CPU ms (1 thread, median) | depth against float32: mean | 99 % |",
        "|---|---|---|---|---|",
    ]
    reference = [models["float32"].log_depth(image) for image in images]
    # Interleaved, so that other load affects all models equally.
    times = [[model.milliseconds(images[0]) for model in models.values()] for _ in range(TIMED_RUNS + 3)][3:]
    for (name, model), ms in zip(models.items(), np.median(times, axis=0), strict=True):
        pairs = zip(images, reference, strict=True)
        error = np.concatenate([np.abs(np.exp(model.log_depth(x) - r) - 1).ravel() for x, r in pairs])
        lines.append(
            f"| {name} | {model.megabytes:.1f} | {ms:.1f} | {error.mean():.2%} | {np.percentile(error, 99):.2%} |"
        )
    return "\n".join(lines)


class _Model:
    """An ONNX file on one thread."""

    def __init__(self, path: Path) -> None:
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = 1, 1
        self.megabytes = path.stat().st_size / 1e6
        options.log_severity_level = 4  # errors are raised anyway
        try:
            self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's errors have no common base class
            reason = " ".join(str(error).split())[-160:]
            raise OutputError(
                f"onnxruntime {onnxruntime.__version__} cannot load the exported file ({reason})"
            ) from None

    def log_depth(self, image: "FloatArray") -> "FloatArray":
        """``(1, 1, H, W)``."""
        return np.asarray(self._session.run(["log_depth"], {"image": image})[0])

    def milliseconds(self, image: "FloatArray") -> float:
        """CPU time of one run; the calling thread does all the work."""
        start = time.thread_time()
        self._session.run(None, {"image": image})
        return 1e3 * (time.thread_time() - start)
