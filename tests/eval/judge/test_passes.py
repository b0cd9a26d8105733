"""What a long flight's passes cost and how far they are off."""

import signal

import numpy as np
import pytest

from edgeslam_torch.eval.judge.passes import Pass, errors_of_passes, interrupted, main, points_a_room
from edgeslam_torch.geometry import sim3


def poses(p):
    T = np.tile(np.eye(4), (len(p), 1, 1))
    T[:, :3, 3] = p
    return T


def test_every_pass_is_compared_in_one_frame(rng):
    """The second of three passes is a decimetre too high; unknown poses and an unfinished pass are left out."""
    truth = rng.uniform(-3, 3, (35, 3))
    S = sim3.exp(np.array([0.5, -0.8, 0.3, 0.4, -0.3, 0.6, np.log(1.4)]))
    estimate = sim3.transform(S, truth)
    assert errors_of_passes(poses(estimate), poses(truth), 10) == pytest.approx([0.0] * 3, abs=1e-9)
    high = truth + np.where((np.arange(35) // 10 == 1)[:, None], [0.0, 0.0, 0.1], 0.0)
    truth[3] = np.nan
    first, second, third = errors_of_passes(poses(sim3.transform(S, high)), poses(truth), 10)
    assert second > 0.06 and max(first, third) < 0.05


def test_points_are_counted_in_their_rooms():
    """Two rows of five rooms of four metres."""
    corners = poses(np.array([[-10.0, -4, 0], [10, -4, 0], [10, 4, 1], [-10, 4, 2]]))
    points = np.array([[-9.0, -3, 1], [-7, -1, 0], [9, -2, 1], [-9, 2, 1], [0, 2, 1], [1, 1, 1], [30, 1, 1]])
    assert points_a_room(points, corners, corners) == [2, 0, 0, 0, 1, 1, 0, 2, 0, 0]


def test_a_pass_in_a_row_of_the_table():
    flown = Pass(4, 3, 2, 20, 300, 4000, np.array([1.0, 2.0, 3.0, 10.0]), 512.4)
    assert flown.cells() == ["4", "75.0", "2", "20", "300", "4000", "4.0", "9", "512"]


@pytest.mark.parametrize(
    "words", [("--world", "block", "--minutes", "0.5"), ("--recording", "x", "--passes", "0"), ("--frames", "3")]
)
def test_a_flight_of_no_pass_is_refused(words, capsys):
    with pytest.raises(SystemExit) as ended:
        main([*words] if "--frames" not in words else ["--recording", "x", *words])
    assert ended.value.code == 2 and "at least" in capsys.readouterr().err


def test_an_interrupt_is_noted_and_ends_nothing_by_itself():
    before = signal.getsignal(signal.SIGINT)
    try:
        asked = interrupted()
        assert not asked()
        signal.raise_signal(signal.SIGINT)
        assert asked()
    finally:
        signal.signal(signal.SIGINT, before)
