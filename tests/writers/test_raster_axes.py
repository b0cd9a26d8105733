import numpy as np
import pytest

from edgeslam_torch.writers.raster_axes import (
    BACKGROUND,
    axes_around,
    draw_grid,
    draw_points,
)


def page(height=120, width=200):
    return np.full((height, width, 3), BACKGROUND, dtype=np.uint8)


def changed(image):
    return (image != np.array(BACKGROUND, np.uint8)).any(axis=2)


def test_all_points_are_shown_at_one_scale_with_y_up(rng):
    points = rng.random((50, 2)) * [3.0, 1.0] + [100.0, -7.0]
    axes = axes_around(page(), points)
    pixels = axes.pixels(points)
    assert (pixels > 0).all() and (pixels < [200, 120]).all()
    (a, b), (p, q) = points[:2], pixels[:2]
    assert q - p == pytest.approx(axes.scale * (b - a) * [1, -1])


def test_a_point_is_drawn_where_it_lies_and_denser_ones_brighter():
    image = page()
    axes = axes_around(image, np.array([[0.0, 0.0], [10.0, 10.0]]))
    points = np.array([[2.0, 8.0]] + [[8.0, 2.0]] * 3)
    draw_points(axes, points, np.ones((4, 3)), cell_px=2)
    assert changed(image).sum() == 8
    (u1, v1), (u2, v2) = axes.pixels(points[[0, 1]]).astype(int)
    assert image[v1, u1, 0] < image[v2, u2, 0] == 255
    assert v1 < v2


def test_the_grid_has_labelled_lines_at_round_numbers():
    picture = page(300, 400)
    axes = axes_around(picture[20:220, 80:380], np.array([[-1.0, -1.0], [1.0, 1.0]]))
    draw_grid(axes, picture, (80, 20))
    zero = axes.pixels(np.zeros((1, 2)))[0].round().astype(int)
    assert changed(axes.image)[zero[1]].all() and changed(axes.image)[:, zero[0]].all()
    assert changed(picture[:, :70]).sum() > 20  # labels of the ticks on the left
