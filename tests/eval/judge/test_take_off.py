"""What a pilot is told by the SLAM while the drone takes off: where it is, and metres that become better."""

import numpy as np
import pytest

from edgeslam_torch.drone.emulator.lockstep import LockstepTello
from edgeslam_torch.drone.emulator.room import drone_at
from edgeslam_torch.eval.judge.navigation.flight import TICK_S, is_beyond
from edgeslam_torch.eval.judge.navigation.perception import FAULTS, IMAGE_SIZE, SlamPerception
from edgeslam_torch.geometry.mount import TELLO_TILT_RAD
from edgeslam_torch.navigation.map_views import MapViews, Places
from edgeslam_torch.synthetic.sites.build import named_site


def told(world, seconds, ahead_s=np.inf, seed=300, ready=True):
    """State and true position at each tick: up and down every 2 s, from ``ahead_s`` on straight ahead."""
    drone, paint, camera = drone_at(named_site(world, seed), TELLO_TILT_RAD, IMAGE_SIZE, ready=ready)
    tello, perception = LockstepTello(drone, paint, seed=seed), SlamPerception(camera, FAULTS["none"], seed)
    tello.send("takeoff")
    while tello.clock_s < seconds:
        yield perception.state(tello.clock_s, tello.advance(TICK_S)), drone.p_w.copy()
        up = 25 if int(tello.clock_s / 2.0) % 2 else -25
        if tello.clock_s > 2.5:
            tello.send("rc 0 45 0 0" if tello.clock_s > ahead_s else f"rc 0 0 {up} 0")


@pytest.mark.slow
def test_a_climb_before_bare_walls_is_not_taken_for_a_turn():
    """It rises and goes up and down on the spot; the map had it 0.6 m ahead and its camera turned by 48 degrees."""
    states = [state for state, _ in told("blank_walls", 9.0)]
    way = np.array([state.p_w for state in states if state.stamp_s > 5.0])
    assert np.ptp(way[:, 2]) > 0.1, "it does go up and down"
    assert np.abs(way[:, :2]).max() < 0.15 and states[-1].tracked


@pytest.mark.slow
def test_a_climb_that_is_seen_to_lean_says_how_far_it_may():
    """The first baseline is a few centimetres: the images explain the climb by a turn, 0.2 m aside."""
    metric = [(state, p_w) for state, p_w in told("cluttered_room", 8.0, seed=904) if state.metric]
    assert len(metric) > 20 and not any(is_beyond(state, p_w) for state, p_w in metric)


@pytest.mark.slow
def test_what_a_pilot_knows_is_moved_with_its_metres_and_the_drone_is_where_it_says():
    """Up and down for 8 s, then ahead through a corridor for 8 s."""
    before, ratios, views, here = None, [], MapViews(), Places()
    for state, p_w in told("corridor", 18.0, 10.0):
        if before is not None and before.revision > 0 and state.revision != before.revision:
            assert state.view is not None and state.map_update is not None
            ratios.append(state.map_update.ratio)
        if state.map_update is not None:
            views.correct(state.map_update)
            assert np.linalg.norm(here.last_w - state.p_w) < 0.1
        if state.view is not None:
            views.add(state.view.picture, state.view.T_w_c)
        here = Places(views, state.p_w, size=3)
        before, true_w = state, p_w
    assert any(abs(ratio - 1.0) > 0.01 for ratio in ratios), "its metres did become others"
    flown = np.linalg.norm(true_w[:2])
    assert flown > 2.5
    assert np.linalg.norm(before.p_w[:2] - true_w[:2]) < 0.05 + 3.0 * before.scale_sigma * flown


@pytest.mark.slow
@pytest.mark.parametrize(("world", "seed"), [("cluttered_room", 742), ("two_rooms", 758)])
def test_a_climb_on_wrong_predicted_depths_is_not_taken_for_sinking(world, seed):
    """The depth network is far off here, and the reversed order of depths explains the images: a camera that sinks
    and turns up by 15 degrees."""
    states = [(state, p_w[2]) for state, p_w in told(world, 8.0, seed=seed, ready=False)]
    climb = [state.p_w[2] for state, z_m in states if z_m > 0.4 and state.stamp_s < 3.0]
    assert np.all(np.diff(climb[::5]) > 0.0)
    last, z_m = states[-1]
    assert last.metric and last.scale_sigma < 0.1 and abs(last.p_w[2] - z_m) < 0.1
