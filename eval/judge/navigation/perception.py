"""Sources of the planner's states in judged flights, with the latency of the video: ground truth, or the SLAM."""

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from edgeslam_torch.drone.emulator.drone import DroneModel
from edgeslam_torch.drone.emulator.lockstep import Event, Outage, Picture, Radio, State
from edgeslam_torch.drone.sdk_state import parse_state, sample_from_sdk
from edgeslam_torch.flying.perception import slam_perception
from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.drone_state import DroneState, View
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.sites.site import Site

DEPTH_SIZE, IMAGE_SIZE = (160, 120), (480, 360)
"""Of true depth, and of the images that the SLAM sees."""
_SIGMA_LOG = 0.01


@dataclass(frozen=True, slots=True)
class Conditions:
    """Faults of a flight."""

    radio: Radio = field(default_factory=Radio)
    wind_m_s: float = 0.0
    """Constant wind across the take-off heading, plus gusts of half of it."""
    scale: float = 1.0
    """True metres per estimated metre: at 1.3 all distances are underestimated by 1.3."""
    stated_scale_sigma: float = 0.0
    battery: float = 1.0
    hung_s: tuple[float, float] = (math.inf, math.inf)
    """Interval in which the planner hangs."""
    dark_s: tuple[float, float] = (math.inf, math.inf)
    """Interval with black frames."""


FAULTS = {
    "none": Conditions(),
    "outage": Conditions(Radio(outages=(Outage("video", 14.0, 17.0),))),
    "loss": Conditions(Radio(loss=0.05)),
    "delay": Conditions(Radio(video_s=0.8)),
    "wind": Conditions(wind_m_s=0.3),
    "scale_long": Conditions(scale=1.3, stated_scale_sigma=0.15),
    "scale_short": Conditions(scale=1.0 / 1.3, stated_scale_sigma=0.15),
    "scale_unsaid": Conditions(scale=1.0 / 1.3),
    "blackout": Conditions(dark_s=(14.0, 60.0)),
    "battery": Conditions(battery=0.28),
    "hung": Conditions(hung_s=(14.0, 60.0)),
}
"""By name; ``scale_unsaid`` is a wrong scale with zero standard deviation."""


class Perception(Protocol):
    """Source of the planner's states."""

    def state(self, now_s: float, events: list[Event]) -> DroneState:
        """Current state from the events since the last call."""


def _within(stamp_s: float, interval_s: tuple[float, float]) -> bool:
    return interval_s[0] <= stamp_s < interval_s[1]


class TruePerception:
    """True current pose and exact depth of arriving frames, to separate planner faults from perception faults."""

    def __init__(self, site: Site, drone: DroneModel, conditions: Conditions) -> None:
        self._site, self._drone, self._conditions = site, drone, conditions
        self._seen_s = 0.0

    def state(self, now_s: float, events: list[Event]) -> DroneState:
        """See `Perception`."""
        view, drone, scale = None, self._drone, self._conditions.scale
        for event in events:
            if isinstance(event, Picture) and not _within(event.captured_s, self._conditions.dark_s):
                view, self._seen_s = self._view(event), event.captured_s
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

    def _view(self, picture: Picture) -> View:
        camera, scale = PRESETS["tello"].scaled(*DEPTH_SIZE), self._conditions.scale
        T_w_c = picture.T_w_b @ camera_on_body()
        depth = render(self._site.painted(picture.captured_s), camera, self._site.T_site_w @ T_w_c).depth_m
        T_w_c[:3, 3] /= scale
        sigma = np.full(depth.shape, _SIGMA_LOG, np.float32)
        return View(picture.captured_s, depth / scale, sigma, camera.K, T_w_c)


class SlamPerception:
    """`slam_perception.SlamPerception` of a flight, fed by events in lockstep, with frames that may go dark."""

    def __init__(self, camera: Camera, conditions: Conditions, seed: int) -> None:
        self._conditions = conditions
        self._perception = slam_perception.SlamPerception(camera, seed)

    def state(self, now_s: float, events: list[Event]) -> DroneState:
        """See `Perception`."""
        view = None
        for event in events:
            if isinstance(event, State):
                self._perception.add_telemetry(sample_from_sdk(event.arrived_s, parse_state(event.text)))
            elif isinstance(event, Picture):
                is_dark = _within(event.captured_s, self._conditions.dark_s)
                image = np.zeros_like(event.image) if is_dark else event.image
                view = self._perception.seen(image, event.arrived_s, event.captured_s) or view
        return self._perception.state(now_s, view)


def nothing_painted(T_w_b: np.ndarray) -> np.ndarray:
    """An empty image: ground truth perception needs none."""
    return np.zeros((1, 1, 3), np.uint8)
