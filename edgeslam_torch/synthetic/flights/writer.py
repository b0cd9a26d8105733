"""A simulated flight as a folder on disk: TUM layout with telemetry, exact depth and ground truth."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.errors import OutputError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.imu_files import write_imu
from edgeslam_torch.files.plain import subfolder, write_image
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.camera_file import save_camera
from edgeslam_torch.imu import ImuModel, ImuReadings
from edgeslam_torch.synthetic.flights.degrade import CLEAN, CameraFaults, degraded
from edgeslam_torch.synthetic.flights.flight import Flight
from edgeslam_torch.synthetic.flights.telemetry import TelemetryLog
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.world import World
from edgeslam_torch.types import FloatArray

DEPTH_PER_METRE = 5000.0
"""16-bit depth maps hold z in fifths of a millimetre, as in the TUM RGB-D benchmark."""


def write_flight(
    folder: Path,
    world: World,
    flight: Flight,
    camera: Camera,
    *,
    telemetry: TelemetryLog | None = None,
    imu: tuple[ImuReadings, ImuModel] | None = None,
    faults: CameraFaults = CLEAN,
    seed: int = 0,
    depth_every: int = 1,
    jpeg_quality: int = 95,
    threads: int = 1,
    on_frame: Callable[[int], None] | None = None,
) -> Path:
    """Render a flight into ``folder`` and return it.

    Args:
        folder: Made when missing; files of an older flight with the same names are replaced.
        world: What is seen.
        flight: Where from.
        camera: Intrinsics.
        telemetry: Written as ``telemetry.csv``.
        imu: Written as ``imu.csv`` and ``imu.yaml``.
        faults: What the camera does to the images.
        seed: Of the image noise; each frame has its own stream.
        depth_every: Write the exact depth of every n-th frame (0 for none).
        jpeg_quality: Of ``rgb/*.jpg``; 0 writes PNG.
        threads: Frames drawn at a time; the bytes do not depend on it.
        on_frame: Called with the number of frames done.

    Raises:
        OutputError: If something cannot be written.
    """
    folder = Path(folder)
    suffix = ".jpg" if jpeg_quality else ".png"
    T_w_c = flight.T_w_c
    rgb, depth = ["# timestamp filename"], ["# timestamp filename"]
    try:
        subfolder(folder, "rgb")
        if depth_every:
            subfolder(folder, "depth")
        save_camera(folder / "camera.yaml", camera)
        _write_text(folder / "groundtruth.txt", _groundtruth_lines(flight.stamps_s, T_w_c))
        if telemetry is not None:
            telemetry.write(folder / "telemetry.csv")
        if imu is not None:
            write_imu(folder, *imu)

        def draw(i: int) -> None:
            view = render(world, camera, T_w_c[i])
            rng, stamp = np.random.default_rng([seed, i]), float(flight.stamps_s[i])
            twist = flight.twist_c(i)
            image = degraded(rng, view.image, view.depth_m, camera, faults, stamp_s=stamp, twist_c=twist)
            options = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if jpeg_quality else []
            write_image(folder / "rgb" / f"{_name(stamp)}{suffix}", image, options)
            if depth_every and i % depth_every == 0:
                steps = np.clip(np.rint(view.depth_m * DEPTH_PER_METRE), 0, 65535).astype(np.uint16)
                write_image(folder / "depth" / f"{_name(stamp)}.png", steps, [cv2.IMWRITE_PNG_COMPRESSION, 1])

        pool = ThreadPoolExecutor(max_workers=threads)
        try:
            for i, _ in enumerate(pool.map(draw, range(len(flight.stamps_s)))):
                stamp = float(flight.stamps_s[i])
                rgb.append(f"{stamp:.6f} rgb/{_name(stamp)}{suffix}")
                if depth_every and i % depth_every == 0:
                    depth.append(f"{stamp:.6f} depth/{_name(stamp)}.png")
                if on_frame is not None:
                    on_frame(i + 1)
        finally:  # after Ctrl-C the frames that wait are not drawn
            pool.shutdown(cancel_futures=True)
        _write_text(folder / "rgb.txt", rgb)
        if depth_every:
            _write_text(folder / "depth.txt", depth)
    except OSError as error:
        raise OutputError(f"{folder}: the simulated flight cannot be written ({error})") from error
    return folder


def _name(stamp_s: float) -> str:
    """File name that sorts by time."""
    return f"{stamp_s:012.6f}"


def _groundtruth_lines(stamps_s: FloatArray, T_w_c: FloatArray) -> list[str]:
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for stamp, T in zip(stamps_s.tolist(), T_w_c, strict=True):
        lines.append(f"{stamp:.6f} " + " ".join(f"{x:.9f}" for x in se3.pose_to_tum(T)))
    return lines


def _write_text(path: Path, lines: list[str]) -> None:
    write_text(path, "\n".join(lines) + "\n")
