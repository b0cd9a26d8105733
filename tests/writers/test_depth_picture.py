"""The colour bar below a depth image."""

import cv2
import numpy as np
import pytest

from edgeslam_torch.writers.depth_picture import BAR_PX, LABELS_PX, colour, round_distances


@pytest.mark.parametrize(
    ("nearest", "farthest", "expected"),
    [
        (0.1, 100.0, [100, 50, 20, 10, 5, 2, 1, 0.5, 0.2, 0.1]),
        (0.9, 5.5, [5, 2, 1]),
        (1.04, 2.5, [2.5, 2, 1.5]),
        (1.04, 2.4, [2.4, 2.2, 2, 1.8, 1.6, 1.4, 1.2]),
        (1.9, 2.1, [2.1, 2, 1.9]),
        (1.999, 2.001, [2.001, 2, 1.999]),
    ],
)
def test_marks_are_round_and_within(nearest, farthest, expected):
    margin = 1e-9
    assert round_distances(1 / farthest - margin, 1 / nearest + margin) == pytest.approx(expected)


def test_a_pixel_has_the_colour_that_the_bar_shows_for_its_depth():
    inverse = np.linspace(0.2, 2.0, 321)  # 5 m to 0.5 m
    depth = np.tile((1 / inverse).astype(np.float32), (50, 1))
    picture = colour(depth)
    assert picture.shape == (50 + BAR_PX + LABELS_PX, 321, 3)
    low, high = np.percentile(inverse, (2, 98))
    for x in (30, 100, 200, 300):
        place = round((inverse[x] - low) / (high - low) * 320)
        difference = np.abs(picture[25, x].astype(int) - picture[52, place].astype(int)).max()
        assert difference <= 12  # two steps of the colour map


def test_unknown_depth_is_black_and_a_picture_of_nothing_says_so():
    depth = np.full((40, 100), 2.0, np.float32)
    depth[:10], depth[10:20], depth[20:30] = np.nan, np.inf, 0.0
    assert (colour(depth)[:30] == 0).all()
    assert (colour(depth)[30:40] > 0).any()
    nothing = colour(np.full((40, 100), np.nan, np.float32))
    assert (nothing[:40] == 0).all()
    assert len(np.unique(cv2.cvtColor(nothing[40:], cv2.COLOR_BGR2GRAY))) > 3  # words
