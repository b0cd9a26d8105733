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
from edgeslam_torch.imu import ImuModel
from edgeslam_torch.synthetic.flights.degrade import CameraFaults, degraded
from edgeslam_torch.synthetic.flights.flight import Flight
from edgeslam_torch.synthetic.flights.imu import mounted, simulate_imu
from edgeslam_torch.synthetic.flights.telemetry import TelemetryFaults, simulate
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.house.world import World

DEPTH_PER_METRE = 5000.0
"""16-bit depth maps hold z in fifths of a millimetre, as in the TUM RGB-D benchmark."""
DEPTH_EVERY = 10
"""Frames from one exact depth map to the next."""
JPEG_QUALITY = 95


def record_flight(
    folder: Path,
    world: World,
    flight: Flight,
    rng: np.random.Generator,
    camera: Camera,
    telemetry: TelemetryFaults | None,
    faults: CameraFaults,
    *,
    seed: int,
    imu: ImuModel | None = None,
    threads: int = 1,
    on_frame: Callable[[int], None] | None = None,
) -> None:
    """Write a flight's images, truth, exact depth, telemetry and IMU readings into ``folder``.

    Args:
        folder: Made when missing; files of an older flight with the same names are replaced.
        world: What is seen.
        flight: Where from.
        rng: Of the telemetry's noise.
        camera: Intrinsics.
        telemetry: None for none.
        faults: What the camera does to the images.
        seed: Of the image and IMU noise; each frame has its own stream.
        imu: Grade of an IMU in the axes of the drone's body; None for none.
        threads: Frames drawn at a time; the bytes do not depend on it.
        on_frame: Called with the number of frames done.

    Raises:
        OutputError: If something cannot be written.
    """
    T_w_c, stamps_s = flight.T_w_c, flight.stamps_s.tolist()
    names = [f"{stamp:012.6f}" for stamp in stamps_s]  # sorted by time
    poses = [" ".join(f"{x:.9f}" for x in se3.pose_to_tum(T)) for T in T_w_c]
    try:
        subfolder(folder, "rgb")
        subfolder(folder, "depth")
        save_camera(folder / "camera.yaml", camera)
        _write_list(folder / "groundtruth.txt", "tx ty tz qx qy qz qw", stamps_s, poses)
        if telemetry is not None:
            floor = world.floor_below(flight.T_w_b[:, :3, 3])
            log = simulate(rng, flight.stamps_s, T_w_c, flight.T_b_c, faults=telemetry, floor_m=floor)
            log.write(folder / "telemetry.csv")
        if imu is not None:
            model = mounted(imu, flight.T_b_c)
            write_imu(folder, simulate_imu(np.random.default_rng([seed, 59]), flight.stamps_s, T_w_c, model), model)

        def draw(i: int) -> None:
            view = render(world, camera, T_w_c[i])
            noise, twist = np.random.default_rng([seed, i]), flight.twist_c(i)
            image = degraded(noise, view.image, view.depth_m, camera, faults, stamp_s=stamps_s[i], twist_c=twist)
            write_image(folder / "rgb" / f"{names[i]}.jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            if i % DEPTH_EVERY == 0:
                steps = np.clip(np.rint(view.depth_m * DEPTH_PER_METRE), 0, 65535).astype(np.uint16)
                write_image(folder / "depth" / f"{names[i]}.png", steps, [cv2.IMWRITE_PNG_COMPRESSION, 1])

        pool = ThreadPoolExecutor(max_workers=threads)
        try:
            for i, _ in enumerate(pool.map(draw, range(len(names)))):
                if on_frame is not None:
                    on_frame(i + 1)
        finally:  # after Ctrl-C the frames that wait are not drawn
            pool.shutdown(cancel_futures=True)
        _write_list(folder / "rgb.txt", "filename", stamps_s, [f"rgb/{name}.jpg" for name in names])
        depth = [f"depth/{name}.png" for name in names[::DEPTH_EVERY]]
        _write_list(folder / "depth.txt", "filename", stamps_s[::DEPTH_EVERY], depth)
    except OSError as error:
        raise OutputError(f"{folder}: the simulated flight cannot be written ({error})") from error


def _write_list(path: Path, columns: str, stamps_s: list[float], rows: list[str]) -> None:
    lines = [f"{stamp:.6f} {row}\n" for stamp, row in zip(stamps_s, rows, strict=True)]
    write_text(path, "".join([f"# timestamp {columns}\n", *lines]))
