"""Perception by SLAM in judged flights, from frames and state messages alone."""

import numpy as np

from edgeslam_torch.drone.emulator.lockstep import Event, Picture, State
from edgeslam_torch.drone.sdk_state import parse_state, sample_from_sdk
from edgeslam_torch.eval.judge.navigation.conditions import Conditions
from edgeslam_torch.flying.perception import slam_perception
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.navigation.drone_state import DroneState, View

IMAGE_SIZE = (480, 360)


class SlamPerception:
    """`SlamPerception` of a flight, fed by events in lockstep, with frames that may go dark."""

    def __init__(self, camera: Camera, conditions: Conditions, seed: int) -> None:
        self._conditions = conditions
        self._perception = slam_perception.SlamPerception(camera, seed)

    def state(self, now_s: float, events: list[Event]) -> DroneState:
        """Current state from the events since the last call."""
        view = None
        for event in events:
            if isinstance(event, State):
                self._perception.heard(sample_from_sdk(event.arrived_s, parse_state(event.text)))
            elif isinstance(event, Picture):
                view = self._step(event) or view
        return self._perception.state(now_s, view)

    def _step(self, picture: Picture) -> View | None:
        dark = self._conditions.dark_s
        is_dark = dark is not None and dark[0] <= picture.captured_s < dark[1]
        image = np.zeros_like(picture.image) if is_dark else picture.image
        return self._perception.seen(image, picture.arrived_s, picture.captured_s)
