"""Saves a running system as MCAP: `--save-mcap`."""

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from edgeslam_torch.config import EdgeConfig
from edgeslam_torch.frontend.edges import extract_edges
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.imu import ImuReadings, separated
from edgeslam_torch.readers.pace import ReadingsCursor
from edgeslam_torch.types import DISAGREEMENT, FloatArray, Frame, FrameStatus, Health, PoseNow, SlamOutput
from edgeslam_torch.writers.mcap import messages
from edgeslam_torch.writers.mcap.ros_file import RosFile

if TYPE_CHECKING:
    from edgeslam_torch.run import Slam

logger = logging.getLogger(__name__)

_GROWTH = 1.1
"""Path and map are written again when they have grown by this: all together stay a multiple of the last."""
_MIN_KEYFRAMES = 3
_SHOWN_EDGES = 20_000
_EDGE_COLOUR, _POINT_COLOUR = (40, 150, 240), (120, 200, 90)
"""BGR."""
_OK, _WARNING, _ERROR = 0, 1, 2


class McapView:
    """A listener of `edgeslam_torch.run.run`; a disk that fills up ends the file, not the run."""

    def __init__(self, camera: Camera, path: Path, readings: ReadingsCursor | None = None) -> None:
        """Open the file.

        Args:
            camera: Of the pictures.
            path: The file.
            readings: Of the source's sensors, of which those of an IMU are written.

        Raises:
            OutputError: If it cannot be written.
            MissingPackageError: If rosbags or mcap is not installed.
        """
        self._file = RosFile(path)
        self._camera, self._readings = camera, readings
        self._edges = EdgeConfig()
        self._keyframes = 0
        self._due = 1.0
        self._last_s = 0.0
        self.failure: str | None = None
        """Why there is no file; None while it grows, and when it is complete."""

    def on_frame(self, frame: Frame, output: SlamOutput, slam: "Slam") -> None:
        """Write pose, picture and state; for keyframes also features, and now and then path and map."""
        self._last_s = output.stamp_s
        self._keyframes += output.keyframe
        imu = [] if self._readings is None else separated(self._readings.until(output.stamp_s))[1]
        self._guarded(lambda: self._write_imu(imu))
        self._guarded(lambda: self._write_frame(frame, output, slam))

    def on_finish(self, slam: "Slam") -> None:
        """Write the refined path and map, and complete the file."""
        self._guarded(lambda: self._write_map(slam))
        ros, t = self._file, self._last_s
        self._guarded(lambda: ros.write("/edgeslam/anchors", t, messages.cloud(ros, t, slam.anchors())))
        self.close()

    def close(self) -> None:
        """Complete the file; may be called repeatedly."""
        self._guarded(self._file.close)

    def _guarded(self, write: Callable[[], None]) -> None:
        if self.failure is not None:
            return
        try:
            write()
        except OSError as error:
            self.failure = f"{self._file.path}: cannot be written ({error.strerror or error})"
            self._file.abandon()
            logger.warning("%s; the run goes on", self.failure)

    def _write_imu(self, parts: Sequence[ImuReadings]) -> None:
        for imu in parts:
            for row in zip(imu.stamps_s.tolist(), imu.angular_rate_rad_s, imu.acceleration_m_s2, strict=True):
                self._file.write("/imu", row[0], messages.imu(self._file, *row))

    def _write_frame(self, frame: Frame, output: SlamOutput, slam: "Slam") -> None:
        ros, t = self._file, output.stamp_s
        ask = getattr(slam, "pose_now", None)
        now: PoseNow | None = None if ask is None else ask(t)
        velocity, covariance = (None, None) if now is None else (now.velocity_w, now.covariance)
        ros.write("/tf", t, messages.transform(ros, t, output.T_w_c))
        ros.write("/edgeslam/odometry", t, messages.odometry(ros, t, output.T_w_c, velocity, covariance))
        image = self._camera.undistort_image(frame.image)
        ros.write("/camera/image/compressed", t, messages.picture(ros, t, image))
        ros.write("/camera/camera_info", t, messages.camera_info(ros, t, self._camera))
        if math.isfinite(output.scale.sigma):
            ros.write("/edgeslam/scale", t, messages.number(ros, output.scale.value))
            ros.write("/edgeslam/scale_sigma", t, messages.number(ros, output.scale.sigma))
        ros.write("/diagnostics", t, messages.diagnostics(ros, t, state_of(output)))
        if output.keyframe:
            drawn = self._drawn(image, slam.keyframes()[-1].features.uv)
            ros.write("/edgeslam/features/compressed", t, messages.picture(ros, t, drawn))
            if self._keyframes >= self._due:
                self._write_map(slam)
                self._due = max(self._keyframes + _MIN_KEYFRAMES, _GROWTH * self._keyframes)

    def _write_map(self, slam: "Slam") -> None:
        ros, t = self._file, self._last_s
        stamps, poses = slam.trajectory()
        ros.write("/edgeslam/path", t, messages.path(ros, t, stamps, poses))
        ros.write("/edgeslam/edge_map", t, messages.cloud(ros, t, slam.edge_map()))

    def _drawn(self, image: np.ndarray, keypoints_uv: FloatArray) -> np.ndarray:
        """Edges and keypoints on a copy of the picture."""
        edges = extract_edges(image, self._edges.canny_low, self._edges.canny_high, _SHOWN_EDGES)
        out = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR) if image.ndim == 2 else image.copy()
        u, v = np.rint(edges.uv).astype(int).T.reshape(2, -1)
        out[np.clip(v, 0, out.shape[0] - 1), np.clip(u, 0, out.shape[1] - 1)] = _EDGE_COLOUR
        for x, y in np.rint(keypoints_uv).astype(int).tolist():
            cv2.circle(out, (x, y), 3, _POINT_COLOUR, 1, cv2.LINE_AA)
        return out


def state_of(output: SlamOutput) -> list[tuple[str, int, str, Mapping[str, object]]]:
    """Tracking and metres as lines of ROS's diagnostics: name, level, words, values."""
    level = _OK if output.status.supported else _WARNING
    if output.status is FrameStatus.LOST:
        level = _ERROR
    tracking = {
        "status": output.status,
        "matches": output.matches,
        "inliers": output.inliers,
        "keyframe": output.keyframe,
        "piece": output.piece,
        "ms": f"{sum(output.stage_ms.values()):.1f}",
    }
    words = f"{output.status} ({output.reason})" if output.reason else str(output.status)
    lines: list[tuple[str, int, str, Mapping[str, object]]] = [("edgeslam: tracking", level, words, tracking)]
    scale = {
        "metric": output.metric,
        "scale": f"{output.scale.value:.6g}",
        "sigma": f"{output.scale.sigma:.3g}",
        "source": output.scale.source,
        "revision": output.revision,
    }
    health = output.health
    doubtful = not output.metric or (health is not None and health.disagreement > DISAGREEMENT)
    said = "metres" if output.metric else "no metres"
    said = said if health is None else str(health)
    lines.append(("edgeslam: scale", _WARNING if doubtful else _OK, said, scale | _of_health(health)))
    return lines


def _of_health(health: Health | None) -> dict[str, object]:
    if health is None:
        return {}
    values: dict[str, object] = {
        "state": health.state,
        "disagreement": f"{health.disagreement:.1f} sigmas",
        "telemetry age": f"{health.telemetry_age_s:.2f} s",
        "video delay": f"{health.delay_s:.3f} s",
        "battery": f"{100 * health.battery:.0f} %",
    }
    values |= {f"doubt {i}": doubt for i, doubt in enumerate(health.doubts, start=1)}
    return {key: value for key, value in values.items() if not str(value).startswith(("nan", "inf"))}
