"""Metric depth on a companion computer: needs onnxruntime, numpy and OpenCV, nothing of EdgeSLAM-Torch.

    python depth_companion.py depth.onnx --fx 925 --fy 925 --source tello.mp4

``depth.onnx`` comes from ``edgeslam export``; everything this script must know about it is inside the file. ``--fx``
and ``--fy`` are those of the undistorted image. ``--source`` is a picture, a video or a camera number.

It ends with 0 once it has measured a frame, and with 1 and one line that says why when there is none.
"""

import argparse
import json
import math
import os
import sys
import time
from collections.abc import Iterator

_MAX_PIXELS = "OPENCV_IO_MAX_IMAGE_PIXELS"
os.environ.setdefault(_MAX_PIXELS, "50000000")  # a picture of a few kilobytes can ask for gigabytes

import cv2  # noqa: E402, it reads the limit while it loads
import numpy as np  # noqa: E402
import onnxruntime  # noqa: E402


class Depth:
    """An exported network on one thread."""

    def __init__(self, path: str, threads: int = 1) -> None:
        """Load the file.

        Raises:
            ValueError: If it is no model that ``edgeslam export`` wrote.
        """
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        try:
            self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's exceptions share no base class of their own
            raise ValueError(f"{path}: not a model that onnxruntime reads ({error})") from error
        try:
            record = json.loads(self.session.get_modelmeta().custom_metadata_map["edgeslam"])
            self.mean, self.std = np.float32(record["mean"]), np.float32(record["std"])
            self.focal_px = float(record["focal_px"])
            self.height, self.width = self.session.get_inputs()[0].shape[2:]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{path}: not written by edgeslam export") from error

    def __call__(self, bgr: np.ndarray, fx: float, fy: float) -> tuple[np.ndarray, np.ndarray]:
        """Depth [m] and standard deviation of log depth of an undistorted BGR image, at the network's size."""
        small = cv2.resize(bgr, (self.width, self.height), interpolation=cv2.INTER_AREA)
        rgb = small[..., ::-1].astype(np.float32) / 255.0
        x = (rgb - self.mean) / self.std
        x = np.ascontiguousarray(x.transpose(2, 0, 1)[None], dtype=np.float32)
        log_depth, sigma_log = self.session.run(["log_depth", "sigma_log"], {"image": x})
        # Metres hold for the focal length of training, in the network's pixels.
        focal = np.sqrt(fx * self.width / bgr.shape[1] * fy * self.height / bgr.shape[0])
        return np.exp(log_depth[0, 0]) * (focal / self.focal_px), sigma_log[0, 0]


def frames(source: str) -> Iterator[np.ndarray]:
    """BGR images of a picture, a video or a camera, one at least.

    Raises:
        ValueError: If there is none.
    """
    camera = source.isascii() and source.isdigit()
    if not camera and not os.path.isfile(source):
        raise ValueError(f"{source}: no such file")
    try:
        picture = None if camera else cv2.imread(source)
    except cv2.error as error:
        raise ValueError(f"{source}: more than {os.environ[_MAX_PIXELS]} pixels") from error
    if picture is not None:
        yield picture
        return
    capture = cv2.VideoCapture(int(source) if camera else source)
    more, frame = capture.read()
    if not more:
        raise ValueError(f"{source}: camera gives no picture" if camera else f"{source}: no picture and no video")
    while more:
        yield frame
        more, frame = capture.read()


def measure(args: argparse.Namespace) -> None:
    """Print the depth in the middle of every frame and the time it took.

    Raises:
        ValueError: If the model or the source cannot be used.
    """
    if not (0 < args.fx < math.inf and 0 < args.fy < math.inf and args.threads >= 1 and args.frames >= 1):
        raise ValueError("--fx, --fy, --threads and --frames must be positive")
    depth = Depth(args.model, args.threads)
    for index, frame in enumerate(frames(args.source)):
        start = time.perf_counter()
        metres, sigma = depth(frame, args.fx, args.fy)
        ms = 1e3 * (time.perf_counter() - start)
        middle = np.s_[metres.shape[0] // 2, metres.shape[1] // 2]
        print(f"frame {index}: {metres[middle]:.2f} m ahead (+- {sigma[middle]:.0%}), {ms:.1f} ms")
        if index + 1 == args.frames:
            return


def main() -> int:
    """Read the options and measure; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--source", required=True, help="picture, video file or camera number")
    parser.add_argument("--fx", type=float, required=True)
    parser.add_argument("--fy", type=float, required=True)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--frames", type=int, default=100)
    try:
        measure(parser.parse_args())
    except ValueError as error:
        sys.stderr.write(f"depth_companion: {' '.join(str(error).split())}\n")
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
