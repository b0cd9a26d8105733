"""Which frames rest on the map, from status tables and maps written by hand."""

import numpy as np

from edgeslam_torch.eval.metrics.support import at_end, live, points_in_view
from edgeslam_torch.geometry.camera import Camera

CAMERA = Camera(100, 80, 100.0, 100.0, 49.5, 39.5)
WALL = np.stack([*np.meshgrid(np.linspace(-0.3, 0.3, 10), np.linspace(-0.3, 0.3, 10)), np.full((10, 10), 2.0)], -1)
POINTS = WALL.reshape(-1, 3)
ROWS = [
    {"status": "starting", "supported": "1"},  # posed again once the map stood
    {"status": "starting", "supported": "0"},
    {"status": "tracked", "supported": "1"},
    {"status": "predicted", "supported": "0"},
    {"status": "relocalised", "supported": "1"},
    {"status": "lost", "supported": "0"},
]


def ended(p_w):
    return at_end(ROWS, np.tile(np.eye(4), (len(ROWS), 1, 1)), p_w, CAMERA).tolist()


def test_live_support_follows_the_status():
    assert live(ROWS).tolist() == [False, False, True, False, True, False]


def test_final_support_is_what_the_run_says():
    assert ended(POINTS) == [True, False, True, False, True, False]


def test_frame_that_sees_none_of_the_delivered_map_does_not_rest_on_it():
    assert not any(ended(POINTS[:20])), "fewer than 30 points"
    assert not any(ended(POINTS * [1, 1, -1])), "the map lies behind the camera"
    assert not any(ended(np.zeros((0, 3))))


def test_points_in_view_are_counted_by_projection():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 1.0  # a metre to the right: the half image is 1 m wide at 2 m, so that x >= 0 stays
    assert points_in_view(T, POINTS, CAMERA).tolist() == [100, 50]
    assert points_in_view(T, np.zeros((0, 3)), CAMERA).tolist() == [0, 0]
