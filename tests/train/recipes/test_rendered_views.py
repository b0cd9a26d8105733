"""Rendered places to learn from."""

import numpy as np
import pytest

from edgeslam_torch.synthetic.sites.build import place
from edgeslam_torch.train.recipes import rendered_views
from edgeslam_torch.train.recipes.rendered_views import stored_views


@pytest.fixture(scope="module")
def corridor():
    return place("long_blank_corridor", np.random.default_rng(0), long=8.0, wide=3.0)


def test_oblique_poses_stand_near_a_wall_and_look_along_or_into_it(corridor):
    rng = np.random.default_rng(1)
    low, high = corridor.bounds_w
    for _ in range(30):
        T_w_c = rendered_views.oblique_pose(rng, corridor)
        assert T_w_c is not None
        p, ahead = T_w_c[:3, 3], T_w_c[:3, 2]
        gaps = np.array([p[0] - low[0], high[0] - p[0], p[1] - low[1], high[1] - p[1]])
        outwards = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
        near = (gaps > 0.29) & (gaps < 1.31)
        assert near.any()
        level = ahead[:2] / np.linalg.norm(ahead[:2])
        into = np.rad2deg(np.arcsin(np.clip(outwards[near] @ level, -1, 1)))
        assert ((into > 4.9) & (into < 75.1)).any()
        np.testing.assert_allclose(T_w_c[:3, :3] @ T_w_c[:3, :3].T, np.eye(3), atol=1e-9)


def test_near_poses_look_at_what_stands_beside_them(corridor):
    """In a corridor without furniture the nearest wall is .3 to 1.25 m away, and mostly in view."""
    rng = np.random.default_rng(2)
    low, high = corridor.bounds_w
    into = []
    for _ in range(30):
        T_w_c = rendered_views.near_pose(rng, corridor)
        assert T_w_c is not None
        p, ahead = T_w_c[:3, 3], T_w_c[:3, 2]
        gaps = np.array([p[0] - low[0], high[0] - p[0], p[1] - low[1], high[1] - p[1]])
        assert 0.25 < gaps.min() < 1.3
        outwards = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])[gaps.argmin()]
        into.append(outwards @ ahead[:2])
    assert np.median(into) > 0.7


@pytest.mark.slow
def test_a_place_depends_on_its_number_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(rendered_views, "LEVEL_VIEWS", 1)
    monkeypatch.setattr(rendered_views, "OBLIQUE_VIEWS", 1)
    monkeypatch.setattr(rendered_views, "NEAR_VIEWS", 1)
    monkeypatch.setattr(rendered_views, "WIDTH", 64)
    monkeypatch.setattr(rendered_views, "HEIGHT", 48)
    for name, count in (("one", 1), ("two", 2)):
        rendered_views._render_file(tmp_path / name, rendered_views.place_views, range(count), 21)
    with np.load(tmp_path / "one") as one, np.load(tmp_path / "two") as two:
        assert 0 < len(one["image"]) < len(two["image"])
        for name in ("image", "depth", "K"):
            np.testing.assert_array_equal(one[name], two[name][: len(one[name])])
    assert all((v.depth_m > 0).any() for v in stored_views(tmp_path / "two"))


def test_flat_views_are_kept_by_lot():
    wall, room = np.full((6, 8), 2.0), np.linspace(1.0, 4.0, 48).reshape(6, 8)
    kept = [rendered_views.is_worth_learning(depth, lot) for depth in (wall, room, 0 * wall) for lot in (0.1, 0.9)]
    assert kept == [True, False, True, True, False, False]


@pytest.mark.slow
def test_files_that_are_there_stay(tmp_path):
    kept = tmp_path / "places_00000.npz"
    kept.write_bytes(b"kept")
    count = rendered_views.PLACES_A_FILE
    assert rendered_views.render_files(tmp_path, rendered_views.place_views, count, 21) == [kept]
    assert kept.read_bytes() == b"kept"
    assert list(tmp_path.iterdir()) == [kept]
