"""Metric depth on a companion computer: needs onnxruntime, numpy and OpenCV, nothing of EdgeSLAM-Torch.

    python depth_companion.py depth.onnx --fx 925 --fy 925 --source tello.mp4

``depth.onnx`` comes from ``edgeslam export``; everything this script must know about it is inside the
file. ``--fx`` and
``--fy`` are those of the undistorted image. ``--source`` is a picture, a video or a camera number.
"""

import argparse
import json
import time

import cv2
import numpy as np
import onnxruntime


class Depth:
    """An exported network on one thread."""

    def __init__(self, path: str, threads: int = 1) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        self.record = json.loads(self.session.get_modelmeta().custom_metadata_map["edgeslam"])
        self.height, self.width = self.session.get_inputs()[0].shape[2:]

    def __call__(self, bgr: np.ndarray, fx: float, fy: float) -> tuple[np.ndarray, np.ndarray]:
        """Depth [m] and standard deviation of log depth of an undistorted BGR image, at the network's
        size."""
        small = cv2.resize(bgr, (self.width, self.height), interpolation=cv2.INTER_AREA)
        rgb = small[..., ::-1].astype(np.float32) / 255.0
        x = (rgb - np.float32(self.record["mean"])) / np.float32(self.record["std"])
        x = np.ascontiguousarray(x.transpose(2, 0, 1)[None], dtype=np.float32)
        log_depth, sigma_log = self.session.run(["log_depth", "sigma_log"], {"image": x})
        # Metres hold for the focal length of training, in the network's pixels.
        focal = np.sqrt(fx * self.width / bgr.shape[1] * fy * self.height / bgr.shape[0])
        return np.exp(log_depth[0, 0]) * (focal / self.record["focal_px"]), sigma_log[0, 0]


def main() -> None:
    """Print the depth in the middle of every frame and the time it took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--source", required=True, help="picture, video file or camera number")
    parser.add_argument("--fx", type=float, required=True)
    parser.add_argument("--fy", type=float, required=True)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--frames", type=int, default=100)
    args = parser.parse_args()
    depth = Depth(args.model, args.threads)
    picture = None if args.source.isdigit() else cv2.imread(args.source)
    capture = cv2.VideoCapture(int(args.source) if args.source.isdigit() else args.source)
    for index in range(args.frames if picture is None else 1):
        more, frame = (True, picture) if picture is not None else capture.read()
        if not more or frame is None:
            break
        start = time.perf_counter()
        metres, sigma = depth(frame, args.fx, args.fy)
        ms = 1e3 * (time.perf_counter() - start)
        middle = np.s_[metres.shape[0] // 2, metres.shape[1] // 2]
        print(f"frame {index}: {metres[middle]:.2f} m ahead (+- {sigma[middle]:.0%}), {ms:.1f} ms")


if __name__ == "__main__":
    main()
