import numpy as np
import pytest

from edgeslam_torch.writers.raster_axes import (
    BACKGROUND,
    axes_around,
    draw_grid,
    draw_path,
    draw_points,
    text,
    text_size,
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


@pytest.mark.parametrize("points", [np.zeros((0, 2)), np.full((1, 2), 5.0), np.array([[np.nan, 0.0], [2.0, 2.0]])])
def test_without_extent_there_are_axes_too(points):
    axes = axes_around(page(), points)
    assert np.isfinite(axes.low).all() and 0 < axes.scale < np.inf


def test_points_outside_are_not_drawn_nor_a_paths_gaps():
    image = page()
    axes = axes_around(image, np.array([[0.0, 0.0], [1.0, 1.0]]))
    draw_points(axes, np.array([[50.0, 0.5], [0.5, -1e9]]), np.ones((2, 3)), cell_px=3)
    assert not changed(image).any()
    draw_path(axes, np.array([[0.0, 0.0], [np.nan, 1.0], [1.0, 1.0], [1e12, 0.0]]), (255, 0, 0), 1)
    assert (image[:, :, 0] > 200).sum() > 50


@pytest.mark.parametrize("at", [(100, 60), (0, 0), (199, 119), (-500, 60)])
def test_text_is_cut_at_the_border(at):
    image = page()
    text(image, "along [m]", at, 0.5, anchor=(0.5, 0.5))
    assert changed(image).any() == (at[0] >= 0)
    image = page(200, 200)
    text(image, "height [m]", (100, 100), 0.5, anchor=(0.5, 0.5), upright=True)
    v, u = np.nonzero(changed(image))
    assert np.ptp(v) == pytest.approx(text_size("height [m]", 0.5)[0], abs=6) and np.ptp(u) < 30
