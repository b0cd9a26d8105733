"""What a world knows about its surfaces and solids, by hand."""

import numpy as np

from edgeslam_torch.synthetic.house.world import Box, Quad, Texture, World, in_parts, to_boxes

FLAT = Texture(np.full((8, 8, 3), 9, np.uint8))


def level(x, y, z, size):
    """Level square by its corner of low x and high y."""
    return Quad(np.array([x, y, z]), np.array([size, 0.0, 0.0]), np.array([0.0, -size, 0.0]), FLAT)


def test_floor_and_distance_to_surfaces():
    world = World([level(-3, 3, 0, 6), level(0, 1, 0.7, 1)])
    p = np.array([[0.5, 0.5, 1.2], [0.5, 0.5, 0.4], [2.0, 2.0, 1.2], [5.0, 0.0, 0.0]])
    np.testing.assert_allclose(world.floor_below(p)[:3], [0.7, 0.0, 0.0])
    np.testing.assert_allclose(world.distance_to_surface(p), [0.5, 0.3, 1.2, 2.0])


def test_clearance_is_the_distance_to_the_nearest_wall_or_solid():
    turned = Box(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.1, 1.0]), np.pi / 2)
    oblique = Box(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.1, 1.0]), np.arctan(0.75))  # along (4, 3)
    world = World([level(-3, 3, 0, 6)], bounds_w=np.array([[-3, -3, 0], [3, 3, 2.5]]), boxes=[turned])
    p = np.array([[1.1, 0.5, 1.0], [0.0, 1.5, 1.0], [2.9, 0.0, 1.0], [0.05, 0.9, 1.0], [3.5, 0.0, 1.0]])
    np.testing.assert_allclose(world.clearance(p), [1.0, 0.5, 0.1, 0.0, -0.5], atol=1e-12)
    beside = np.array([[0.8, 0.6, 1.0], [1.2, 0.9, 1.0], [-0.6, 0.8, 1.0]])  # on its end, half a metre on, across
    np.testing.assert_allclose(in_parts(to_boxes([oblique]), np.tile(beside, (200, 1)))[-3:], [0.0, 0.5, 0.9])
    assert np.isinf(to_boxes([])(p)).all()
