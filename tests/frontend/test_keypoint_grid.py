"""Which keypoints lie near given pixels."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from edgeslam_torch.frontend.keypoint_grid import KeypointGrid, nearest_pixels


@pytest.mark.parametrize("count", [1, 60, 2000])
def test_keypoints_lie_within_each_radius(rng, count):
    """Queries inside the image, on its border and far outside; radii from a pixel to the whole image."""
    uv, query = rng.uniform(0, 300, (count, 2)), rng.uniform(-200, 500, (70, 2))
    radius = rng.choice([0.0, 1.0, 8.0, 40.0, 900.0], 70)
    i, j = KeypointGrid(uv).near(query, radius)
    near = np.linalg.norm(query[:, None] - uv[None], axis=2) <= radius[:, None]
    found = np.zeros_like(near)
    found[i, j] = True
    np.testing.assert_array_equal(found, near)
    assert len(i) == near.sum()


@pytest.mark.parametrize("count", [1, 4])
def test_the_nearest_pixels_are_a_trees(rng, count):
    uv, query = np.float32(rng.uniform(0, 300, (60, 2))), rng.uniform(-50, 350, (70, 2))
    distance, nearest = nearest_pixels(uv, query, count)
    apart, true = cKDTree(uv).query(query, k=[*range(1, count + 1)])
    np.testing.assert_array_equal(nearest, true)
    np.testing.assert_allclose(distance, apart, rtol=1e-12)


def test_nothing_is_near_nothing():
    grid = KeypointGrid(np.zeros((0, 2), np.float32))
    assert len(grid) == 0
    assert [len(side) for side in grid.near(np.zeros((5, 2)), np.ones(5))] == [0, 0]
    assert [len(side) for side in KeypointGrid(np.ones((3, 2))).near(np.zeros((0, 2)), np.ones(0))] == [0, 0]
