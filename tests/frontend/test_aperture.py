"""Corners against keypoints on edges, on pictures whose answer is known."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.frontend.aperture import are_corners


def wedge(angle_deg, contrast=120.0, turn_deg=0.0, noise=0.0):
    """A picture with two edges that meet in its middle, 64 x 64."""
    v, u = np.mgrid[-32:32, -32:32] + 0.5
    bearing = np.rad2deg(np.arctan2(v, u)) - turn_deg
    inside = (bearing % 360.0) < angle_deg
    grey = cv2.GaussianBlur(60.0 + contrast * inside, (0, 0), 1.0)
    grey = grey + np.random.default_rng(0).normal(0.0, noise, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


MIDDLE = np.array([[31.5, 31.5]], np.float32)


@pytest.mark.parametrize("turn_deg", [0.0, 20.0, 45.0, 110.0])
def test_a_right_angle_is_a_corner_and_a_straight_edge_is_none(turn_deg):
    assert are_corners(wedge(90.0, turn_deg=turn_deg), MIDDLE, np.ones(1)).all()
    assert not are_corners(wedge(180.0, turn_deg=turn_deg), MIDDLE, np.ones(1)).any()


def test_noise_on_an_edge_makes_no_corner():
    assert not are_corners(wedge(180.0, noise=3.0), MIDDLE, np.ones(1)).any()


def test_the_window_grows_with_the_pyramid_level():
    """An edge that bends 10 px away is straight on level 0 and a corner four times as coarse."""
    grey, away = wedge(90.0), np.array([[43.5, 31.5]], np.float32)
    assert not are_corners(grey, away, np.ones(1)).any()
    assert are_corners(cv2.resize(grey, None, fx=4, fy=4), 4 * MIDDLE, np.full(1, 4.0)).all()
    assert are_corners(grey, away, np.full(1, 4.0)).all()


def test_each_keypoint_is_evaluated_at_its_position():
    grey = wedge(90.0)
    uv = np.array([[50.0, 31.5], [31.5, 31.5], [5.0, 5.0], [31.5, 55.0], [0.0, 63.0]], np.float32)
    assert are_corners(grey, uv, np.ones(5)).tolist() == [False, True, False, False, False]


def test_no_keypoints():
    assert are_corners(wedge(90.0), np.zeros((0, 2), np.float32), np.zeros(0)).shape == (0,)
