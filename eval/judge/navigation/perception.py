"""Ground truth perception with the latency of the video."""

import math

import numpy as np

from edgeslam_torch.drone.emulator.drone import DroneModel
from edgeslam_torch.drone.emulator.lockstep import Event, Picture
from edgeslam_torch.eval.judge.navigation.conditions import Conditions
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.drone_state import DroneState, View
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.sites.site import Site

DEPTH_SIZE = (160, 120)
_SIGMA_LOG = 0.01


class TruePerception:
    """True current pose and exact depth of arriving frames, to separate planner faults from perception faults."""

    def __init__(self, site: Site, drone: DroneModel, conditions: Conditions) -> None:
        self._site, self._drone, self._conditions = site, drone, conditions
        self._camera = PRESETS["tello"].scaled(*DEPTH_SIZE)
        self._T_b_c = camera_on_body()
        self._seen_s = 0.0

    def state(self, now_s: float, events: list[Event]) -> DroneState:
        """Current state from the events since the last call."""
        view = None
        for event in events:
            if isinstance(event, Picture) and not self._dark(event.captured_s):
                view, self._seen_s = self._view(event), event.captured_s
        drone, scale = self._drone, self._conditions.scale
        return DroneState(
            now_s,
            drone.p_w / scale,
            drone.yaw,
            drone.velocity / scale,
            scale_sigma=self._conditions.stated_scale_sigma,
            seen_s=self._seen_s,
            battery=drone.battery,
            view=view,
        )

    def _dark(self, stamp_s: float) -> bool:
        dark = self._conditions.dark_s
        return dark is not None and dark[0] <= stamp_s < dark[1]

    def _view(self, picture: Picture) -> View:
        T_w_c = picture.T_w_b @ self._T_b_c
        world = self._site.painted(picture.captured_s)
        depth = render(world, self._camera, self._site.T_site_w @ T_w_c, antialias=False).depth_m
        T_w_c[:3, 3] /= self._conditions.scale
        sigma = np.full(depth.shape, _SIGMA_LOG, np.float32)
        return View(picture.captured_s, depth / self._conditions.scale, sigma, self._camera.K, T_w_c)


def nothing_painted(T_w_b: np.ndarray) -> np.ndarray:
    """An empty image: ground truth perception needs none."""
    assert math.isfinite(float(T_w_b[0, 3]))
    return np.zeros((1, 1, 3), np.uint8)
