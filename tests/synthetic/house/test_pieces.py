"""Furniture as data: every piece is built, stands where it is put, and takes no more floor than it says."""

import numpy as np
import pytest

from edgeslam_torch.synthetic.house.dressing import fits
from edgeslam_torch.synthetic.house.pieces import build, drawn, furniture, stand
from edgeslam_torch.synthetic.house.scene import Paint, Place, Scene

CHAIR_M = 0.55
"""A desk's chair stands in the floor kept free before it, and is turned."""


def scene():
    return Scene(np.array([-5.0, -5.0, 0.0]), np.array([5.0, 5.0, 2.6]))


def corners(built):
    """Corners of all surfaces ``(N, 3)``."""
    return np.concatenate(
        [[s.origin_w, s.origin_w + s.u_w, s.origin_w + s.v_w, s.origin_w + s.u_w + s.v_w] for s in built.quads]
    )


@pytest.mark.parametrize("name", furniture())
def test_furniture_stands_on_the_floor_that_it_takes(name):
    front = furniture()[name].get("front", 0.0)
    for seed in range(6):
        rng, built = np.random.default_rng(seed), scene()
        width, depth = drawn(rng, name)
        stand(built, Place(0.0, 0.0, 0.0), rng, name, width, depth)
        built.quads = [s for s in built.quads if not s.two_sided]  # leaves
        low, high = corners(built).min(0), corners(built).max(0)
        room = 0.25  # things that lie obliquely near the border of a top
        assert low[0] > -width / 2 - room and high[0] < width / 2 + room
        assert low[1] > -room and high[1] < depth + front + room + (CHAIR_M if front else 0.0)
        assert -1e-9 < low[2] < 0.3 and high[2] < 2.6
        assert len(built.boxes) > 0


@pytest.mark.parametrize("name", furniture())
def test_a_piece_is_turned_and_moved_as_a_whole(name):
    here, there = Place(0.0, 0.0, 0.0), Place(1.0, -0.5, 0.7, 0.1)
    one, other = scene(), scene()
    rngs = [np.random.default_rng(3) for _ in range(2)]
    for built, place, rng in zip((one, other), (here, there), rngs, strict=True):
        stand(built, place, rng, name, 1.0, 0.6)
    moved = np.array([there.point(p) for p in corners(one)])
    np.testing.assert_allclose(corners(other), moved, atol=1e-9)
    assert rngs[0].random() == rngs[1].random(), "painted alike"


@pytest.mark.parametrize(("x", "free"), [(1.1, True), (1.0, False), (0.5, False), (4.4, True), (4.6, False)])
def test_a_piece_fits_beside_another_and_within_the_room(x, free):
    built = scene()
    built.box(Place(0.0, 0.0, 0.0), (0.0, 0.5, 0.5), (1.0, 1.0, 1.0), Paint("metal"), "block")
    assert fits(built, Place(x, 0.0, 0.0), 1.0, 0.5) is free


def test_a_pile_of_books_stays_below_the_next_board():
    for seed in range(20):
        built = scene()
        build(built, Place(0.0, 0.0, 0.0), np.random.default_rng(seed), "books", headroom=0.05)
        assert all(b.centre_w[2] + b.half_m[2] <= 0.05 for b in built.boxes)


def test_values_that_are_given_are_not_drawn():
    drawn, given = scene(), scene()
    assert 0.82 <= build(drawn, Place(0.0, 0.0, 0.0), np.random.default_rng(0), "door")["wide"] <= 0.95
    build(given, Place(0.0, 0.0, 0.0), np.random.default_rng(0), "door", wide=2.0, height=1.0)
    panel = next(s for s in given.quads if s.name == "door")
    assert (np.linalg.norm(panel.u_w), np.linalg.norm(panel.v_w)) == pytest.approx((2.0, 1.0))
