"""What the SLAM takes a take-off for, before walls that show no corners."""

import numpy as np
import pytest

from edgeslam_torch.drone.emulator.lockstep import LockstepTello
from edgeslam_torch.drone.emulator.room import drone_at
from edgeslam_torch.eval.judge.navigation.perception import FAULTS, IMAGE_SIZE, SlamPerception
from edgeslam_torch.geometry.mount import TELLO_TILT_RAD
from edgeslam_torch.synthetic.sites.build import named_site

TICK_S = 1.0 / 15.0


@pytest.mark.slow
def test_a_climb_before_bare_walls_is_not_taken_for_a_turn():
    """It rises and goes up and down on the spot; the map had it 0.6 m ahead and its camera turned by 48 degrees."""
    site = named_site("blank_walls", 300)
    drone, paint, camera = drone_at(site, TELLO_TILT_RAD, IMAGE_SIZE)
    tello, perception = LockstepTello(drone, paint, seed=300), SlamPerception(camera, FAULTS["none"], 300)
    tello.send("takeoff")
    told = []
    while tello.clock_s < 9.0:
        told.append(perception.state(tello.clock_s, tello.advance(TICK_S)))
        if tello.clock_s > 2.5:
            tello.send(f"rc 0 0 {25 if int(tello.clock_s / 2.0) % 2 else -25} 0")
    way = np.array([state.p_w for state in told if state.stamp_s > 5.0])
    assert np.ptp(way[:, 2]) > 0.1, "it does go up and down"
    assert np.abs(way[:, :2]).max() < 0.15 and told[-1].tracked
