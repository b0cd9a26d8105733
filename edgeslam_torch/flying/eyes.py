"""What a pilot is told: what the SLAM knows, from pictures and state messages alone."""

import threading
from collections import deque

import cv2
import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.frontend.depth_network import DepthNetwork, open_depth
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.moved import Moved, moves
from edgeslam_torch.navigation.near_depth import fit_to_points
from edgeslam_torch.navigation.sight import Sight, View
from edgeslam_torch.navigation.space import CELL_M, KEPT
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.types import FloatArray, Frame, SlamOutput, TelemetrySample

IMAGE_WIDTH = 480
"""Wider pictures are halved until they are not wider than this: the width at which flights were judged."""
_DEPTH_EVERY = 3
"""Frames from one depth map to the next: 5 a second."""
_GROUND_M = 0.1
"""Height of the camera when the drone stands on the floor."""
_STEP = 4
"""Depth is handed on at a quarter of the picture's size."""
_LOST = ("lost", "starting")
_DISAGREE_SIGMAS = 3.0
_WIDEST_SIGMA_M = 0.2
_MOVES_EVERY_S = 3.0
"""Least time between two moves of the map in one unit: each costs a pilot as much as all its views together."""


class SlamEyes:
    """Pictures and state messages through `EdgeSlam`; the pose is made up for the video's delay.

    The world has its origin on the floor where the drone stood in the first picture, and x along its heading there.
    `heard` and `sight` may be called from any thread, also while `seen` works; `seen` from one thread.

    Args:
        camera: Of the pictures.
        seed: Of the SLAM.
        realtime: Whether mapping works beside the pictures, as in flight, or within them, as in repeatable tests.
    """

    def __init__(self, camera: Camera, seed: int = 0, realtime: bool = False) -> None:
        width, height = camera.width, camera.height
        while width > IMAGE_WIDTH and width % 2 == height % 2 == 0:
            width, height = width // 2, height // 2
        self._camera = camera.scaled(width, height)
        self._slam = EdgeSlam(self._camera, SlamConfig(seed=seed), realtime=realtime)
        self._network: DepthNetwork = open_depth()
        self._T_b_c = camera_on_body()
        self._lock = threading.Lock()
        self._samples: list[TelemetrySample] = []
        """Of which no finished step knows."""
        self._frames = 0
        self._captured_s = 0.0
        self._output: SlamOutput | None = None
        self._T_home_slam: FloatArray = np.eye(4)
        self._battery = 1.0
        self._told_height_m = np.nan
        self._shown: tuple[FloatArray, float] = np.zeros((0, 4, 4)), 1.0
        """Poses ``(F, 4, 4)`` of all pictures when the last view was made, and the unit of the map then."""
        self._told: deque[tuple[int, FloatArray]] = deque(maxlen=KEPT)
        """Pictures whose views were told, and their poses as they were told last."""
        self._told_unit, self._moved_s = 1.0, -np.inf
        self._revision = 0

    def heard(self, sample: TelemetrySample) -> None:
        """Take a state message."""
        with self._lock:
            self._samples.append(sample)
            if np.isfinite(sample.battery):
                self._battery = sample.battery
            if np.isfinite(sample.height_m):
                self._told_height_m = sample.height_m + _GROUND_M

    def seen(self, image: np.ndarray, arrived_s: float, captured_s: float) -> View | None:
        """Take a picture ``(H, W, 3)`` BGR; every few pictures of a mapped place give depth in metres."""
        size = (self._camera.width, self._camera.height)
        if image.shape[1::-1] != size:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        with self._lock:
            batch = list(self._samples)
        output = self._slam.step(Frame(self._frames, arrived_s, image), batch)
        T_slam = self._slam.trajectory()[1]
        home = self._home(T_slam[0])
        with self._lock:
            del self._samples[: len(batch)]
            self._output, self._captured_s, self._T_home_slam = output, captured_s, home
        self._frames += 1
        revised, self._revision = output.revision != self._revision, output.revision
        if (self._frames % _DEPTH_EVERY and not revised) or not _tracks(output):
            return None
        view = self._view(image, output, captured_s)
        with self._lock:
            self._shown = home @ T_slam, output.unit
        return view

    def sight(self, now_s: float, view: View | None = None) -> Sight:
        """The moment, with a new view if there is one, and with it how the map moved since the last."""
        with self._lock:
            output, captured_s, home = self._output, self._captured_s, self._T_home_slam
            samples, battery, told = list(self._samples), self._battery, self._told_height_m
        pose = self._slam.pose_now(now_s, samples)
        if pose is None or output is None or output.health is None:
            nowhere = np.array([0.0, 0.0, _GROUND_M])
            return Sight(
                now_s,
                nowhere,
                0.0,
                np.zeros(3),
                metric=False,
                tracked=False,
                seen_s=captured_s,
                battery=battery,
                told_height_m=told,
            )
        health = output.health
        T_w_b = home @ pose.T_w_c @ se3.inverse(self._T_b_c)
        relative = health.scale.sigma / health.scale.value
        sigma = float(np.sqrt(np.clip(np.trace(pose.covariance[:3, :3]) / 3.0, 0.0, None)))
        return Sight(
            now_s,
            T_w_b[:3, 3],
            float(np.arctan2(T_w_b[1, 0], T_w_b[0, 0])),
            home[:3, :3] @ np.asarray(pose.velocity_w),
            position_sigma_m=min(sigma, _WIDEST_SIGMA_M),
            scale_sigma=relative if np.isfinite(relative) else 1.0,
            metric=health.metric,
            tracked=_tracks(output),
            conflict=health.disagreement > _DISAGREE_SIGMAS,
            seen_s=captured_s,
            battery=battery,
            told_height_m=told,
            view=view,
            revision=pose.revision,
            moved=None if view is None else self._moved(view),
        )

    def close(self) -> None:
        """Stop the SLAM's threads."""
        self._slam.close()

    def _moved(self, view: View) -> Moved | None:
        """How the views that were told have moved when this one was made; this one counts as told from now on."""
        with self._lock:
            T_w_c, unit = self._shown
        found = None
        if self._told:
            before = np.array([T for _, T in self._told])
            after = T_w_c[[picture for picture, _ in self._told]]
            revised = unit != self._told_unit
            if revised or (view.stamp_s - self._moved_s > _MOVES_EVERY_S and moves(before, after, CELL_M)):
                found, self._moved_s = Moved(before, after, unit / self._told_unit), view.stamp_s
                self._told = deque(((k, T) for (k, _), T in zip(self._told, after, strict=True)), self._told.maxlen)
        self._told.append((view.picture, view.T_w_c))
        self._told_unit = unit
        return found

    def _home(self, T_first: FloatArray) -> FloatArray:
        """``(4, 4)`` from the SLAM's world to the one whose origin is below the first picture's body."""
        T_w_b = T_first @ se3.inverse(self._T_b_c)
        yaw = float(np.arctan2(T_w_b[1, 0], T_w_b[0, 0]))
        out = np.eye(4)
        out[:2, :2] = [[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]]
        out[:3, 3] = -out[:3, :3] @ T_w_b[:3, 3] + [0.0, 0.0, _GROUND_M]
        return out

    def _view(self, image: np.ndarray, output: SlamOutput, captured_s: float) -> View | None:
        """Depth of the network, brought to the map's metres."""
        depth = self._network(image, self._camera)
        anchors = self._slam.anchors()
        fit = fit_to_points(depth, self._camera.K, output.T_w_c, anchors.p_w.astype(np.float64))
        if fit is None:
            return None
        metres = fit.applied(depth)
        K = self._camera.K / _STEP
        K[2, 2] = 1.0
        K[:2, 2] += 0.5 / _STEP - 0.5
        part = (slice(_STEP // 2, None, _STEP), slice(_STEP // 2, None, _STEP))
        T_w_c = self._T_home_slam @ output.T_w_c
        return View(captured_s, metres.depth_m[part], metres.sigma_log[part], K, T_w_c, self._frames - 1)


def _tracks(output: SlamOutput) -> bool:
    return output.health is not None and output.health.state not in _LOST
