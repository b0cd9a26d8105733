"""Accuracy of near depth: the nearest obstacle in each narrow sector of a view against ground truth."""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from edgeslam_torch.drone.emulator.lockstep import Event, Picture
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.drone_state import DroneState, View
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.synthetic.sites.site import Site
from edgeslam_torch.types import FloatArray

SECTOR_RAD = math.radians(3.7)
NEAR_M = (0.3, 1.0)
TOO_FAR_M = 0.3
_SIGMAS = 2.0
"""As in the occupancy grid."""


@dataclass(frozen=True, slots=True)
class NearCounts:
    """Sectors whose true nearest surface is within `NEAR_M`."""

    sectors: int = 0
    too_far: int = 0
    """Those in which the view's nearest depth is more than `TOO_FAR_M` too far."""
    surely_too_far: int = 0
    """The same for depth less two standard deviations, as used by the occupancy grid."""

    def __add__(self, other: "NearCounts") -> "NearCounts":
        return NearCounts(
            self.sectors + other.sectors,
            self.too_far + other.too_far,
            self.surely_too_far + other.surely_too_far,
        )


def near_counts(view: View, true_m: FloatArray) -> NearCounts:
    """Compare a view with the true depth of its pixels.

    Args:
        view: Depth with standard deviation; a sector without depth is unknown, hence not free and not too far.
        true_m: ``(H, W)`` z-depth [m].
    """
    known = np.isfinite(view.depth_m) & (view.depth_m > 0)
    measured = np.where(known, view.depth_m, np.inf)
    lower = np.where(known, measured * np.exp(-_SIGMAS * view.sigma_log), np.inf)
    true = np.where(np.isfinite(true_m) & (true_m > 0), true_m, np.inf)
    angle = np.arctan((np.arange(true.shape[1]) - view.K[0, 2]) / view.K[0, 0])
    sector = np.floor((angle - angle[0]) / SECTOR_RAD).astype(int)
    counts = NearCounts()
    for k in range(int(sector[-1]) + 1):
        nearest, expected, at_least = (float(d[:, sector == k].min()) for d in (true, measured, lower))
        if NEAR_M[0] <= nearest <= NEAR_M[1]:
            far = [math.isfinite(d) and d - nearest > TOO_FAR_M for d in (expected, at_least)]
            counts += NearCounts(1, int(far[0]), int(far[1]))
    return counts


class _Perception(Protocol):
    def state(self, now_s: float, events: list[Event]) -> DroneState: ...


class WatchedPerception:
    """Wraps a perception and records, per metric view, near-depth errors and the age of depth."""

    def __init__(self, perception: _Perception, site: Site) -> None:
        self.counts = NearCounts()
        self.depth_age_s: list[float] = []
        """Age of the newest depth at each tick."""
        self._seen_s = math.nan
        self._perception, self._site = perception, site
        self._T_b_c = camera_on_body()

    def state(self, now_s: float, events: list[Event]) -> DroneState:
        """State of the wrapped perception."""
        state = self._perception.state(now_s, events)
        if state.view is not None:
            self._seen_s = state.view.stamp_s
        if math.isfinite(self._seen_s):
            self.depth_age_s.append(now_s - self._seen_s)
        if state.view is not None and state.metric:
            for event in events:
                if isinstance(event, Picture) and event.captured_s == state.view.stamp_s:
                    self.counts += near_counts(state.view, self._true(event, state.view))
        return state

    def _true(self, picture: Picture, view: View) -> FloatArray:
        height, width = view.depth_m.shape
        T_site_c = self._site.T_site_w @ picture.T_w_b @ self._T_b_c
        camera = PRESETS["tello"].scaled(width, height)
        return render(self._site.painted(picture.captured_s), camera, T_site_c, antialias=False).depth_m
