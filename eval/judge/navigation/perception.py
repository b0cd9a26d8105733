"""Sources of the planner's states in judged flights, with the latency of the video: ground truth, or the SLAM; how far
off the nearest obstacles of their views are."""

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
from edgeslam_torch.synthetic.house.render import depth_map
from edgeslam_torch.synthetic.sites.site import Site
from edgeslam_torch.types import FloatArray

DEPTH_SIZE, IMAGE_SIZE = (160, 120), (480, 360)
"""Of true depth, and of the images that the SLAM sees."""
_SIGMA_LOG = 0.01
SECTOR_RAD, NEAR_M, TOO_FAR_M = math.radians(3.7), (0.3, 1.0), 0.3
_SIGMAS = 2.0
"""As in the occupancy grid."""


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
        depth, scale = true_depth(self._site, picture, DEPTH_SIZE), self._conditions.scale
        T_w_c = picture.T_w_b @ camera_on_body()
        T_w_c[:3, 3] /= scale
        sigma = np.full(depth.shape, _SIGMA_LOG, np.float32)
        return View(picture.captured_s, depth / scale, sigma, PRESETS["tello"].scaled(*DEPTH_SIZE).K, T_w_c)


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


def true_depth(site: Site, picture: Picture, size: tuple[int, int]) -> FloatArray:
    """Exact z-depth ``(H, W)`` [m] of a picture."""
    T_site_c = site.T_site_w @ picture.T_w_b @ camera_on_body()
    return depth_map(site.painted(picture.captured_s), PRESETS["tello"].scaled(*size), T_site_c)


def near_counts(view: View, true_m: FloatArray) -> np.ndarray:
    """Accuracy of near depth: the nearest obstacle in each narrow sector of a view against the truth.

    Args:
        view: Depth with standard deviation; a sector without depth is unknown, hence not free and not too far.
        true_m: ``(H, W)`` z-depth [m].

    Returns:
        Number of sectors whose true nearest surface is within `NEAR_M`; of those in which the view's nearest depth is
        more than `TOO_FAR_M` too far; the same for depth less two standard deviations, as used by the occupancy grid.
    """
    known = np.isfinite(view.depth_m) & (view.depth_m > 0)
    measured = np.where(known, view.depth_m, np.inf)
    lower = np.where(known, measured * np.exp(-_SIGMAS * view.sigma_log), np.inf)
    true = np.where(np.isfinite(true_m) & (true_m > 0), true_m, np.inf)
    angle = np.arctan((np.arange(true.shape[1]) - view.K[0, 2]) / view.K[0, 0])
    sector = np.floor((angle - angle[0]) / SECTOR_RAD).astype(int)
    counts = np.zeros(3, dtype=int)
    for k in range(int(sector[-1]) + 1):
        nearest, *stated = (float(d[:, sector == k].min()) for d in (true, measured, lower))
        if NEAR_M[0] <= nearest <= NEAR_M[1]:
            counts += [1, *(math.isfinite(d) and d - nearest > TOO_FAR_M for d in stated)]
    return counts


class WatchedPerception:
    """Wraps a perception and records, per metric view, near-depth errors and the age of depth."""

    def __init__(self, perception: Perception, site: Site) -> None:
        self.counts = np.zeros(3, dtype=int)
        """Sums of `near_counts`."""
        self.depth_age_s: list[float] = []
        """Age of the newest depth at each tick."""
        self._seen_s = math.nan
        self._perception, self._site = perception, site

    def state(self, now_s: float, events: list[Event]) -> DroneState:
        """State of the wrapped perception."""
        state = self._perception.state(now_s, events)
        view = state.view
        if view is not None:
            self._seen_s = view.stamp_s
        if math.isfinite(self._seen_s):
            self.depth_age_s.append(now_s - self._seen_s)
        if view is not None and state.metric:
            size = view.depth_m.shape[1], view.depth_m.shape[0]
            for event in events:
                if isinstance(event, Picture) and event.captured_s == view.stamp_s:
                    self.counts += near_counts(view, true_depth(self._site, event, size))
        return state
