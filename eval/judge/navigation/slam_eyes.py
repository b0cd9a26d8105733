"""What a pilot is told in the judged flights: what the SLAM knows, from pictures and state lines alone."""

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.drone.emulator.lockstep import Event, Picture, State
from edgeslam_torch.drone.sdk_state import parse_state, sample_from_sdk
from edgeslam_torch.eval.judge.navigation.conditions import Conditions
from edgeslam_torch.frontend.depth_network import DepthNetwork, open_depth
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.near_depth import fit_to_points
from edgeslam_torch.navigation.sight import Sight, View
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.types import FloatArray, Frame, SlamOutput, TelemetrySample

IMAGE_SIZE = (480, 360)
_DEPTH_EVERY = 3
"""Frames from one depth map to the next: 5 a second."""
_GROUND_M = 0.1
"""Height of the camera when the drone stands on the floor."""
_STEP = 4
"""Depth is handed on at a quarter of the picture's size."""
_LOST = ("lost", "starting")


class SlamEyes:
    """Pictures and state lines through `EdgeSlam`; the pose is made up for the video's delay."""

    def __init__(self, camera: Camera, conditions: Conditions, seed: int) -> None:
        self._camera, self._conditions = camera, conditions
        self._slam = EdgeSlam(camera, SlamConfig(seed=seed))
        self._network: DepthNetwork = open_depth()
        self._T_b_c = camera_on_body()
        self._samples: list[TelemetrySample] = []
        self._frames = 0
        self._captured_s = 0.0
        self._output: SlamOutput | None = None
        self._battery = 1.0
        self._now_s = 0.0

    def sight(self, now_s: float, events: list[Event]) -> Sight:
        """The moment, from what arrived since the last one."""
        view = None
        for event in events:
            if isinstance(event, State):
                sample = sample_from_sdk(event.arrived_s, parse_state(event.text))
                self._samples.append(sample)
                self._battery = sample.battery if np.isfinite(sample.battery) else self._battery
            elif isinstance(event, Picture):
                view = self._step(event) or view
        return self._told(now_s, view)

    def _step(self, picture: Picture) -> View | None:
        dark = self._conditions.dark_s
        image = picture.image
        if dark is not None and dark[0] <= picture.captured_s < dark[1]:
            image = np.zeros_like(image)
        frame = Frame(self._frames, picture.arrived_s, image)
        self._output = self._slam.step(frame, self._samples)
        self._samples, self._captured_s = [], picture.captured_s
        self._frames += 1
        if self._frames % _DEPTH_EVERY or not self._tracks():
            return None
        return self._view(image, picture.captured_s)

    def _view(self, image: np.ndarray, captured_s: float) -> View | None:
        """Depth of the network, brought to the map's metres."""
        assert self._output is not None
        anchors = self._slam.anchors()
        depth = self._network(image, self._camera)
        fit = fit_to_points(depth, self._camera.K, self._output.T_w_c, anchors.p_w.astype(np.float64))
        if fit is None:
            return None
        metres = fit.applied(depth)
        K = self._camera.K / _STEP
        K[2, 2] = 1.0
        K[:2, 2] += 0.5 / _STEP - 0.5
        part = (slice(_STEP // 2, None, _STEP), slice(_STEP // 2, None, _STEP))
        T_w_c = self._in_drones_world(self._output.T_w_c)
        return View(captured_s, metres.depth_m[part], metres.sigma_log[part], K, T_w_c)

    def _in_drones_world(self, T_w_c: FloatArray) -> FloatArray:
        """The pose in the world whose origin is on the floor where the drone stood."""
        first = self._slam.trajectory()[1][0]
        out = np.array(T_w_c)
        out[:3, 3] += self._T_b_c[:3, 3] + [0.0, 0.0, _GROUND_M] - first[:3, 3]
        return out

    def _tracks(self) -> bool:
        health = None if self._output is None else self._output.health
        return health is not None and health.state not in _LOST

    def _told(self, now_s: float, view: View | None) -> Sight:
        pose = self._slam.pose_now(now_s, self._samples)
        if pose is None or self._output is None or self._output.health is None:
            nowhere = np.array([0.0, 0.0, _GROUND_M])
            return Sight(now_s, nowhere, 0.0, np.zeros(3), metric=False, tracked=False, seen_s=self._captured_s)
        health = self._output.health
        T_w_b = self._in_drones_world(pose.T_w_c) @ se3.inverse(self._T_b_c)
        yaw = float(np.arctan2(T_w_b[1, 0], T_w_b[0, 0]))
        sigma = float(np.sqrt(np.clip(np.trace(pose.covariance[:3, :3]) / 3.0, 0.0, None)))
        relative = health.scale.sigma / health.scale.value
        return Sight(
            now_s,
            T_w_b[:3, 3],
            yaw,
            np.asarray(pose.velocity_w),
            position_sigma_m=min(sigma, 0.2),
            scale_sigma=relative if np.isfinite(relative) else 1.0,
            metric=health.metric,
            tracked=self._tracks(),
            conflict=health.disagreement > 3.0,
            seen_s=self._captured_s,
            battery=self._battery,
            view=view,
            revision=pose.revision,
        )
