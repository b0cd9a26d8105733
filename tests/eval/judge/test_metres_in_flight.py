"""The metres that a pilot is told by the SLAM while they become better: all that it knows goes along."""

import numpy as np
import pytest

from edgeslam_torch.drone.emulator.lockstep import LockstepTello
from edgeslam_torch.drone.emulator.room import drone_at
from edgeslam_torch.eval.judge.navigation.perception import FAULTS, IMAGE_SIZE, SlamPerception
from edgeslam_torch.geometry.mount import TELLO_TILT_RAD
from edgeslam_torch.navigation.map_views import MapViews, Places
from edgeslam_torch.synthetic.sites.build import named_site

TICK_S = 1.0 / 15.0


@pytest.mark.slow
def test_what_a_pilot_knows_is_moved_with_its_metres_and_the_drone_is_where_it_says():
    """Up and down for 8 s, then ahead through a corridor for 8 s."""
    site = named_site("corridor", 300)
    drone, paint, camera = drone_at(site, TELLO_TILT_RAD, IMAGE_SIZE)
    tello, perception = LockstepTello(drone, paint, seed=300), SlamPerception(camera, FAULTS["none"], 300)
    tello.send("takeoff")
    before, ratios, views, here = None, [], MapViews(), Places()
    while tello.clock_s < 18.0:
        state = perception.state(tello.clock_s, tello.advance(TICK_S))
        tello.send(sticks(tello.clock_s))
        if before is not None and before.revision > 0 and state.revision != before.revision:
            assert state.view is not None and state.map_update is not None
            ratios.append(state.map_update.ratio)
        if state.map_update is not None:
            views.correct(state.map_update)
            assert np.linalg.norm(here.last_w - state.p_w) < 0.1
        if state.view is not None:
            views.add(state.view.picture, state.view.T_w_c)
        here = Places(views, state.p_w, size=3)
        before = state
    assert any(abs(ratio - 1.0) > 0.01 for ratio in ratios), "its metres did become others"
    flown = np.linalg.norm(drone.p_w[:2])
    assert flown > 2.5
    assert np.linalg.norm(before.p_w[:2] - drone.p_w[:2]) < 0.05 + 3.0 * before.scale_sigma * flown


def sticks(clock_s):
    """Up and down every 2 s, then ahead."""
    if clock_s > 10.0:
        return "rc 0 45 0 0"
    return f"rc 0 0 {25 if int(clock_s / 2.0) % 2 else -25} 0" if clock_s > 2.5 else "rc 0 0 0 0"
