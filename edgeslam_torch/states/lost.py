"""Lost: the pose is predicted, every frame tries to relocalise, and after a while a new submap is started."""

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.states.machine import Event, Machine
from edgeslam_torch.states.starting import AFTER_LOSS, Starting
from edgeslam_torch.states.step import Step
from edgeslam_torch.states.system import MIN_KEYPOINTS, System
from edgeslam_torch.states.tracking import Tracking
from edgeslam_torch.tracking.lazy_view import LazyView
from edgeslam_torch.tracking.tracker import View
from edgeslam_torch.types import FloatArray, Frame, FrameStatus

LOST_BEFORE_RESTART_S = 0.65
"""Time without a pose after which a new submap is started at the predicted one."""

UNCONFIRMED = "looks like a known place, the next frames must agree"
"""Reason given for an unconfirmed relocalisation."""


class Lost:
    """The state without a pose."""

    def __init__(self, system: System, tracking: Tracking, starting: Starting) -> None:
        self.system = system
        self.tracking = tracking
        self.starting = starting

    def step(self, frame: Frame, seen: LazyView, machine: Machine) -> Step:
        """Relocalise the frame, else predict its pose or start a new submap."""
        T_predicted = self.system.predict(frame.stamp_s, lost=True)
        found = self.tracking.search(frame, seen, T_predicted, machine.lost_frames)
        return found or self.miss(frame, seen.view, T_predicted, machine.lost_since_s)

    def begin(self, frame: Frame, view: View) -> Step:
        """The first lost frame."""
        self.system.events["lost"] += 1
        return self.miss(frame, view, self.system.predict(frame.stamp_s, lost=False), np.inf)

    def miss(self, frame: Frame, view: View, T_predicted: FloatArray, lost_since_s: float) -> Step:
        """Predict the pose, or start a new submap there after a longer loss."""
        system = self.system
        self.tracking.lost.append((frame.index, view))
        system.motion.drift(T_predicted)
        system.fusion.add_visual(frame.stamp_s, se3.inverse(T_predicted), np.inf, np.inf, tracked=False)
        seen = len(view.features.uv)
        # Without a map to return to, as after dark first images, the conditions of a first map apply.
        enough = 2 * MIN_KEYPOINTS if len(system.map.anchors) > 0 else MIN_KEYPOINTS
        waiting = self.tracking.relocaliser.waiting > 0
        if frame.stamp_s - lost_since_s >= LOST_BEFORE_RESTART_S and seen >= enough and not waiting:
            system.events["restarted"] += 1
            system.motion.stop()
            return self.starting.begin(frame, view, AFTER_LOSS)
        reason = f"only {seen} keypoints" if seen < MIN_KEYPOINTS else "too few keypoints agree with the map"
        reason = UNCONFIRMED if waiting else reason
        return Step(Event.NOTHING, system.map.latest(), FrameStatus.PREDICTED, reason)
