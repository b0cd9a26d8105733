"""Which frames rest on the map, from status tables written by hand."""

import numpy as np

from edgeslam_torch.eval.judge.support import at_end, live, pieces, points_in_view
from edgeslam_torch.geometry.camera import Camera

CAMERA = Camera(100, 80, 100.0, 100.0, 49.5, 39.5)
WALL = np.stack([*np.meshgrid(np.linspace(-0.3, 0.3, 10), np.linspace(-0.3, 0.3, 10)), np.full((10, 10), 2.0)], -1)
POINTS = WALL.reshape(-1, 3)


def rows(text):
    """``i`` guessed, ``I`` guessed and keyframe, ``t`` tracked, ``p`` predicted, ``l`` lost."""
    names = {"i": "initialised", "t": "tracked", "p": "predicted", "l": "lost", "r": "relocalised"}
    return [{"status": names[c.lower()], "keyframe": str(int(c.isupper()))} for c in text]


def ended(text, p_w=POINTS):
    T = np.tile(np.eye(4), (len(text), 1, 1))
    return "".join("x" if ok else "." for ok in at_end(rows(text), T, p_w, CAMERA))


def test_live_support_is_neither_guessed_nor_predicted():
    assert live(rows("IiItrpl")).tolist() == [False, False, False, True, True, False, False]


def test_attempt_that_came_through_is_supported_in_the_end():
    assert ended("IiiItt") == "xxxxxx"


def test_attempts_that_were_given_up_are_not_supported():
    # The first attempt ends with the second one's reference keyframe; the second comes through.
    assert ended("IiiIiItt") == "...xxxxx"
    assert ended("IiIi") == "...."


def test_frames_that_were_lost_stay_unsupported():
    assert ended("IItplIiItt") == "xxx..xxxxx"


def test_frame_that_sees_none_of_the_delivered_map_does_not_rest_on_it():
    assert ended("IItt", POINTS[:20]) == "....", "fewer than 30 points"
    assert ended("IItt", POINTS * [1, 1, -1]) == "....", "the map lies behind the camera"


def test_pieces_are_maps_that_were_started():
    assert pieces(rows("IiIttt")) == 1
    assert pieces(rows("IItplIiItt")) == 2
    assert pieces(rows("IiiIii")) == 0
    assert pieces(rows("tttt")) == 1, "a map from frame 0"
    assert pieces([]) == 0


def test_points_in_view_are_counted_by_projection():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 1.0  # a metre to the right: the half image is 1 m wide at 2 m, so that x >= 0 stays
    assert points_in_view(T, POINTS, CAMERA).tolist() == [100, 50]
    assert points_in_view(T, np.zeros((0, 3)), CAMERA).tolist() == [0, 0]
