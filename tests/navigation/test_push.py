"""Contact detection by the pose and by reported velocities."""

import numpy as np
import pytest

from edgeslam_torch.navigation.contact import Push
from edgeslam_torch.navigation.drone_state import DroneState

AHEAD = np.array([1.0, 0.0])


def held_after_s(velocities_w, reported_m_s, towards_w=lambda k: AHEAD, seconds=6.0):
    """Time of the first contact, at 20 states a second; None if never."""
    push = Push()
    for k in range(round(20 * seconds)):
        now = k / 20
        state = DroneState(now, np.zeros(3), 0.0, np.array([*velocities_w(k), 0.0]), reported_speed_m_s=reported_m_s(k))
        if push.holds(state, towards_w(k), now):
            return now
    return None


def shaking(k):
    """A tenth of a metre a second to and fro: nowhere."""
    return 0.1 * (-1.0) ** k, 0.05 * (-1.0) ** (k // 2)


@pytest.mark.parametrize(
    ("velocities_w", "reported_m_s"),
    [
        (lambda k: (0.0, 0.0), lambda k: np.nan),
        (lambda k: (0.03, 0.0), lambda k: 0.3),  # the radio repeats an old message
        (shaking, lambda k: 0.0),
        (lambda k: (-0.2, 0.0), lambda k: 0.0),  # a pose that runs away
    ],
)
def test_contact_after_a_second_and_a_half(velocities_w, reported_m_s):
    assert held_after_s(velocities_w, reported_m_s) == pytest.approx(1.55, abs=0.06)


@pytest.mark.parametrize(
    ("velocities_w", "reported_m_s"),
    [
        (lambda k: (0.2, 0.0), lambda k: 0.2),
        (lambda k: (0.2, 0.0), lambda k: 0.0),  # the drone repeats that it stands, and the pictures move
        (shaking, lambda k: np.nan),  # nothing tells shaking from moving
        (shaking, lambda k: 0.1),
        (lambda k: (0.0, 0.2), lambda k: 0.2),  # along what it pushes against
    ],
)
def test_moving_is_no_contact(velocities_w, reported_m_s):
    assert held_after_s(velocities_w, reported_m_s) is None


def test_to_and_fro_is_no_push():
    """A second in each direction: no command lasts long enough."""
    assert held_after_s(lambda k: (0.0, 0.0), lambda k: 0.0, lambda k: AHEAD * (-1.0) ** (k // 20)) is None


def test_a_pause_begins_it_anew():
    assert held_after_s(lambda k: (0.0, 0.0), lambda k: 0.0, lambda k: None if k % 25 == 24 else AHEAD) is None


def test_a_pause_resets_the_detection():
    push = Push()
    still = DroneState(0.0, np.zeros(3), 0.0, np.zeros(3))
    assert not any(push.holds(still, AHEAD, k / 20) for k in range(20))
    assert not push.holds(still, AHEAD, 9.0)
    assert any(push.holds(still, AHEAD, 9.0 + k / 20) for k in range(40))
