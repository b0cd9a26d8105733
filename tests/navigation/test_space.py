"""Occupancy grid from depth: free, occupied and unknown space."""

from dataclasses import replace

import numpy as np
import pytest
from views import K, facing_a_wall, longer, moved

from edgeslam_torch.navigation.drone_state import Contact
from edgeslam_torch.navigation.space import Space


def seen(space, times=3, **view):
    for _ in range(times):
        space.observe(facing_a_wall(**view))
    return space.layer(1.15, 0.15)


def cell(layer, x, y):
    i, j = layer.cells(np.array([x, y]))
    return bool(layer.free[i, j]), bool(layer.solid[i, j])


def test_unknown_space_is_not_free():
    assert not Space().layer(1.15, 0.15).free.any()


def test_wall_is_occupied_front_free_back_unknown():
    layer = seen(Space())
    assert cell(layer, 1.55, 0.05) == (True, False)
    assert cell(layer, 2.05, 0.05)[1] or cell(layer, 1.95, 0.05)[1]
    assert cell(layer, 2.55, 0.05) == (False, False)
    assert cell(layer, 1.0, 1.5) == (False, False)  # beside the field of view
    assert cell(layer, -1.0, 0.05) == (False, False)  # behind the camera


def test_rays_free_up_to_two_sigmas_before_their_end():
    """A depth of 2 m within 20 % may be 1.34 m: nothing beyond that is free."""
    layer = seen(Space(), sigma=0.2)
    line = np.array([[x, 0.05] for x in np.arange(0.55, 2.0, 0.1)])
    free = [cell(layer, *p)[0] for p in line]
    farthest = line[np.flatnonzero(free).max(), 0]
    assert 1.1 < farthest < 2.0 * np.exp(-0.4)


def test_thin_obstacle_survives_its_background():
    space = Space()
    view = facing_a_wall(4.0)
    view.depth_m[:, 39:41] = 1.55  # a rod of two pixels: 4 cm
    for _ in range(5):
        space.observe(view)
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 1.55, 0.0)[1] or cell(layer, 1.55, -0.05)[1]
    assert not cell(layer, 3.0, 0.0)[0]


def test_a_point_in_a_fine_picture_keeps_its_own_sigma_when_the_picture_is_made_smaller():
    """A network that is sure to 30 % fills nothing beyond a metre; a point of the map before it does."""
    view = facing_a_wall(4.0)
    depth, sigma = (np.repeat(np.repeat(grid, 2, 0), 2, 1) for grid in (view.depth_m, view.sigma_log))
    depth[:, 81], sigma[:] = 1.55, 0.3
    sigma[:, 81] = 0.05
    K_fine = view.K.copy()
    K_fine[:2] *= 2.0
    K_fine[:2, 2] += 0.5
    space = Space()
    space.observe(replace(view, depth_m=depth, sigma_log=sigma, K=K_fine))
    layer = space.layer(1.15, 0.15)
    at = 1.55 * np.array([1.0, -(40.0 - 39.5) / 77.0])  # the coarse picture's column 40
    assert cell(layer, *at)[1]


def test_depth_ramp_marks_nothing():
    """A network draws no edge but a ramp: a door's frame at 1 m, and the room behind it."""
    view = facing_a_wall(3.0)
    view.depth_m[:, :30] = 1.0
    ramped = facing_a_wall(3.0)
    ramped.depth_m[:, :30] = 1.0
    ramped.depth_m[:, 30:36] = np.linspace(1.0, 3.0, 8)[1:-1]
    for picture in (view, ramped):
        space = Space()
        for _ in range(3):
            space.observe(picture)
        layer = space.layer(1.15, 0.15)
        solid = layer.centres(np.argwhere(layer.solid))
        assert ((solid[:, 0] > 1.25) & (solid[:, 0] < 2.75)).sum() == 0
        assert (np.abs(solid[:, 0] - 1.0) < 0.1).any()
        assert (np.abs(solid[:, 0] - 3.0) < 0.1).any()


@pytest.mark.parametrize("side_m", [0.8, 1.5])
def test_a_wall_along_the_way_is_no_ramp(side_m):
    view = facing_a_wall(9.0)
    z = K[0, 0] * side_m / np.maximum(39.5 - np.arange(80.0), 0.5)
    view.depth_m[:] = np.minimum(z, 9.0)[None]
    space = Space()
    space.observe(view)
    layer = space.layer(1.15, 0.15)
    seen_m = z[z < 4.5]
    assert len(seen_m) > 10
    assert all(any(cell(layer, x, side_m + off)[1] for off in (-1e-3, 1e-3)) for x in seen_m)


def test_path_flown_is_free():
    space = Space()
    space.flown(np.array([0.5, 0.5, 1.15]), 0.2)
    layer = space.layer(1.15, 0.05)
    assert cell(layer, 0.5, 0.5)[0]
    assert not cell(layer, 1.0, 0.5)[0]


@pytest.mark.parametrize(("hits", "stays_free"), [(2, True), (3, False)])
def test_single_hits_do_not_occupy_where_the_body_passed(hits, stays_free):
    space = Space()
    space.flown(np.array([2.0, 0.0, 1.15]), 0.2)
    for k in range(hits):
        space.observe(facing_a_wall(2.05, picture=k))
    assert cell(space.layer(1.15, 0.05), 2.05, 0.05) == (stays_free, not stays_free)


def test_grid_follows_map_corrections():
    space = Space()
    seen(space)
    space.correct(moved(0, facing_a_wall(x=1.0).T_w_c))
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 2.55, 0.05) == (True, False)
    assert cell(layer, 3.05, 0.05)[1] or cell(layer, 2.95, 0.05)[1]
    assert not cell(layer, 0.55, 0.05)[0]


def test_grid_follows_scale_changes():
    """Metres of 2 m become 1.5 times as long: the wall is 3 m away, and a place flown through 1 m to the side 1.5 m."""
    space = Space()
    seen(space)
    space.flown(np.array([0.0, 1.0, 1.15]), 0.2)
    space.correct(moved(0, facing_a_wall().T_w_c, 1.5))
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 2.55, 0.05) == (True, False)
    assert cell(layer, 3.05, 0.05)[1] or cell(layer, 2.95, 0.05)[1]
    layer = space.layer(1.15, 0.05)
    assert cell(layer, 0.05, 1.55)[0] and not cell(layer, 0.05, 1.05)[0]


def test_redundant_views_are_dropped():
    space = Space()
    for k in range(300):
        space.observe(facing_a_wall(x=0.01 * min(k, 100), picture=k))
    space.correct(longer(1.0))
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 0.75, 0.05) == (True, False) and cell(layer, 1.55, 0.05) == (True, False)


def test_reset_wall_stays_unknown_until_observed_again():
    """The space in front stays free, the wall is not freed."""
    space, there = Space(), facing_a_wall(x=1.0).T_w_c
    seen(space)
    space.doubt_solids()
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 1.55, 0.05) == (True, False) and not layer.solid.any() and not cell(layer, 2.05, 0.05)[0]
    space.correct(moved(0, there))
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 2.55, 0.05) == (True, False) and not layer.solid.any()
    layer = seen(space, x=1.0, picture=1, stamp_s=1.0)
    assert cell(layer, 3.05, 0.05)[1] or cell(layer, 2.95, 0.05)[1]
    space.correct(longer(1.0))
    assert space.layer(1.15, 0.15).solid.any(), "what was seen again stays"


def test_grid_follows_the_drone():
    space = Space()
    before = cell(seen(space), 1.55, 0.05)
    space.follow(np.array([4.0, 0.0, 1.15]))
    layer = space.layer(1.15, 0.15)
    assert layer.corner_w[0] == pytest.approx(-8.0 + 4.0)
    assert cell(layer, 1.55, 0.05) == before


def test_points_of_the_map_are_solid():
    space = Space()
    seen(space)
    space.mark(np.array([[1.05, 0.05, 1.15]]))
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 1.05, 0.05) == (False, True)


def test_unknown_depth_changes_nothing():
    space = Space()
    view = facing_a_wall()
    view.depth_m[:] = np.nan
    space.observe(view)
    layer = space.layer(1.15, 0.15)
    assert not layer.free.any() and not layer.solid.any()


def test_heights_outside_the_grid_are_refused():
    with pytest.raises(ValueError, match="outside"):
        Space().layer(2.4, 0.2)


def test_uncertain_surface_stays_unknown():
    """2 m within 20 % is not an obstacle at 2 m: it may stand anywhere around, and stays unseen."""
    layer = seen(Space(), sigma=0.2)
    assert cell(layer, 1.0, 0.05) == (True, False)
    assert not layer.solid.any()
    assert seen(Space(), sigma=0.1).solid.any()


def test_contact_stays_occupied():
    space = Space()
    layer = seen(space, distance_m=4.0)
    assert cell(layer, 1.22, 0.05) == (True, False)
    space.add_contact(Contact(np.array([1.05, 0.05, 1.15]), np.array([1.0, 0.0])), 0.17)
    layer = seen(space, distance_m=4.0)
    assert cell(layer, 1.22, 0.05) == (False, True), "ahead of the drone"
    assert cell(layer, 0.88, 0.05) == (True, False), "not behind it"
    assert cell(layer, 1.05, 0.25) == (True, False), "not beside it"


def test_contacts_follow_map_corrections():
    space, shifted = Space(), np.eye(4)
    space.map_views.add(0, np.eye(4))
    space.add_contact(Contact(np.array([1.05, 0.05, 1.15]), np.array([1.0, 0.0])), 0.17)
    shifted[:3, 3] = [1.0, 2.0, 0.0]
    space.correct(moved(0, shifted))
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 2.22, 2.05)[1] and not cell(layer, 1.22, 0.05)[1]


def test_contact_outside_the_grid_is_ignored():
    space = Space()
    space.add_contact(Contact(np.array([100.0, 0.0, 1.15]), np.array([1.0, 0.0])), 0.17)
    assert not space.layer(1.15, 0.15).solid.any()


def test_path_flown_follows_grid_and_map():
    """Within a cell of it; after metres have become twice as long, twice as far away."""
    space = Space()
    for x in np.arange(0.05, 4.0, 0.1):
        space.flown(np.array([x, 0.05, 1.15]), 0.2)
    places = np.array([[2.05, 0.05], [2.05, -0.05], [2.05, 0.25], [7.0, 0.05]])
    assert space.was_at(places).tolist() == [True, True, False, False]
    space.follow(np.array([3.0, 0.0, 1.15]))
    assert space.was_at(places).tolist() == [True, True, False, False]
    space.correct(longer(2.0))
    assert space.was_at(places).tolist() == [True, False, True, True]
    assert not space.was_at(np.array([50.0, 0.0]))


def test_older_views_can_be_dropped_but_contacts_and_the_last_metre_flown_stay():
    space = Space()
    for stamp_s, yaw in ((1.0, 0.0), (1.2, 0.0), (1.4, 0.0), (5.0, np.pi / 2), (5.2, np.pi / 2), (5.4, np.pi / 2)):
        space.observe(replace(facing_a_wall(yaw=yaw), stamp_s=stamp_s))
    for x in (-3.0, -0.5, -0.4):
        space.flown(np.array([x, 0.0, 1.15]), 0.3)
    space.add_contact(Contact(np.array([0.0, -2.0, 1.15]), np.array([0.0, -1.0])), 0.3)
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 1.55, 0.05)[0] and cell(layer, 0.05, 1.55)[0] and cell(layer, -3.0, 0.0)[0]
    space.forget_before(5.0)
    layer = space.layer(1.15, 0.15)
    assert cell(layer, 0.05, 1.55) == cell(layer, -0.55, 0.0) == (True, False)
    assert space.was_at(np.array([[-0.5, 0.0], [-3.0, 0.0]])).tolist() == [True, False]
    for x, y in ((1.55, 0.05), (2.05, 0.05), (-3.0, 0.0)):
        assert cell(layer, x, y) == (False, False)
    assert cell(layer, 0.0, -2.3) == (False, True)
