"""Image arithmetic that must not depend on the processor: compared with whole-number arithmetic."""

from fractions import Fraction

import numpy as np

from edgeslam_torch.synthetic.textures.image_ops import looked_up, product, resized, shrunk


def test_a_product_is_the_nearest_grey_level():
    a, b = np.meshgrid(np.arange(256, dtype=np.uint8), np.arange(256, dtype=np.uint8))
    nearest = (2 * a.astype(int) * b + 255) // 510  # a b / 255 never lies between two levels
    np.testing.assert_array_equal(product(a, b / np.float32(255)), nearest)


def test_a_mean_is_exact_and_halves_go_up():
    image = np.random.default_rng(0).integers(0, 256, (35, 10, 3), dtype=np.uint8)
    out = shrunk(image, 7, 25)
    for row, column, channel in np.ndindex(out.shape):
        assert out[row, column, channel] == _area_mean(image[..., channel], row, column, 25, 7)


def _area_mean(image, row, column, height, width):
    """Mean of the source under one pixel by fractions, to the nearest level, halves up."""
    down, across = Fraction(image.shape[0], height), Fraction(image.shape[1], width)
    rows = [_overlap(i, row * down, (row + 1) * down) for i in range(image.shape[0])]
    columns = [_overlap(j, column * across, (column + 1) * across) for j in range(image.shape[1])]
    total = sum(int(image[i, j]) * r * c for i, r in enumerate(rows) if r for j, c in enumerate(columns) if c)
    return int(total / (down * across) + Fraction(1, 2))


def _overlap(pixel, low, high):
    return max(Fraction(0), min(high, Fraction(pixel + 1)) - max(low, Fraction(pixel)))


def test_interpolation_meets_a_ramp():
    ramp = np.arange(0, 250, 10, dtype=np.uint8)[None].repeat(4, axis=0)
    out = resized(ramp, 100, 4)
    inside = 10 * ((np.arange(100) + 0.5) / 4 - 0.5)
    np.testing.assert_allclose(out[0, 4:-4], inside[4:-4], atol=0.51)


def test_a_look_up_is_exact_at_steps_of_a_256th():
    rng = np.random.default_rng(1)
    image = rng.integers(0, 256, (50, 70, 3), dtype=np.uint8)
    x, y = np.rint(256 * rng.uniform(0, [69, 49], (40, 60, 2))).astype(int).transpose(2, 0, 1)
    (column, fx), (row, fy) = (np.divmod(v, 256) for v in (x, y))
    fx, fy, low = fx[..., None], fy[..., None], np.pad(image.astype(int), ((0, 1), (0, 1), (0, 0)))
    above = (256 - fx) * low[row, column] + fx * low[row, column + 1]
    below = (256 - fx) * low[row + 1, column] + fx * low[row + 1, column + 1]
    expected = np.rint(((256 - fy) * above + fy * below) / 65536)
    np.testing.assert_array_equal(looked_up(image, x / 256, y / 256), expected)
