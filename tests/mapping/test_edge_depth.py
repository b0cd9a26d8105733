"""Edge depth by search along epipolar lines, on rendered scenes with exact depth."""

from functools import lru_cache

import cv2
import numpy as np
import pytest
from rendered import CAMERA, film, patchwork, sideways

from edgeslam_torch.frontend.edges import extract_edges
from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.edges.edge_depth import StereoView, measure_edge_depth
from edgeslam_torch.synthetic.house.world import Quad, Texture, World


@lru_cache(maxsize=2)
def slanted_wall(striped=False):
    """A wall turned by 25 degrees about 2 m away, seen from five places 6 cm apart."""
    rng = np.random.default_rng(5)
    if striped:
        stripes = np.repeat(rng.integers(20, 235, 96), 8).astype(np.uint8)
        texture = Texture(np.repeat(np.repeat(stripes[:, None], 768, axis=1)[..., None], 3, axis=2))
    else:
        texture = Texture(patchwork(rng))
    c, s = np.cos(0.44), np.sin(0.44)
    u, v = np.array([6.0 * c, 0.0, 6.0 * s]), np.array([0.0, 6.0, 0.0])
    world = World([Quad(np.array([0.0, 0.0, 2.0]) - 0.5 * (u + v), u, v, texture)])
    poses = sideways(5, 0.06)
    if striped:
        poses[:, 1, 3] = 0.0  # strictly along the stripes
    return film(world, CAMERA, poses)


def views_of(flight):
    return [
        StereoView(cv2.cvtColor(f.image, cv2.COLOR_BGR2GRAY), se3.inverse(T))
        for f, T in zip(flight.frames, flight.T_w_c, strict=True)
    ]


def measured(flight, prior_factor=1.0, sigma_log=0.35, brighter=0.0):
    views = views_of(flight)
    edges = extract_edges(flight.frames[2].image, 40.0, 100.0, 1500)
    u, v = edges.uv.astype(int).T
    truth = flight.depth_m[2][v, u].astype(np.float64)
    n = len(truth)
    result = measure_edge_depth(
        views[2],
        edges.uv,
        edges.normal,
        np.full(n, prior_factor * np.median(truth)),
        np.full(n, sigma_log),
        [StereoView(cv2.convertScaleAbs(views[t].grey, beta=brighter), views[t].T_c_w) for t in (0, 1, 3, 4)],
        CAMERA,
    )
    return result, truth


def test_depth_of_a_planar_scene_is_exact_to_a_tenth_of_a_pixel():
    """12 cm baseline at 2 m and 260 px: a tenth of a pixel of 15.6 px disparity is 0.6 % of the depth."""
    result, truth = measured(slanted_wall())
    known = np.isfinite(result.inverse_depth)
    error = np.abs(result.inverse_depth * truth - 1.0)[known]
    assert known.mean() > 0.4
    assert np.median(error) < 0.006
    assert np.mean(error < 0.03) > 0.9  # the rest takes the border of another rectangle for its own


@pytest.mark.parametrize(("factor", "brighter"), [(0.75, 0.0), (1.3, 0.0), (1.0, 6.0)])
def test_a_prior_with_an_error_of_a_third_and_a_change_of_brightness_change_little(factor, brighter):
    result, truth = measured(slanted_wall(), factor, brighter=brighter)
    known = np.isfinite(result.inverse_depth)
    assert known.mean() > 0.25
    assert np.median(np.abs(result.inverse_depth * truth - 1.0)[known]) < (0.01 if brighter else 0.006)


def test_true_depth_outside_the_search_gives_no_measurement():
    """An overconfident prior three times too deep: almost nothing may count as measured."""
    result, _ = measured(slanted_wall(), 3.0, 0.1)
    assert np.isfinite(result.inverse_depth).mean() < 0.05


def test_edges_along_the_epipolar_line_are_omitted():
    result, _ = measured(slanted_wall(True))
    assert len(result.inverse_depth) > 200
    assert np.isfinite(result.inverse_depth).mean() < 0.01


@lru_cache(maxsize=1)
def pickets():
    """Upright stripes, 4 cm light and 4 cm dark, on a wall 2 m away; cameras 6 cm to either side."""
    stripes = np.repeat(np.tile(np.uint8([60, 200]), 75), 8)
    texture = Texture(np.repeat(np.repeat(stripes[None], 1200, axis=0)[..., None], 3, axis=2))
    u, v = np.array([6.0, 0.0, 0.0]), np.array([0.0, 6.0, 0.0])
    world = World([Quad(np.array([-3.0, -3.0, 2.0]), u, v, texture)])
    poses = sideways(3, 0.06)
    poses[:, 1, 3] = 0.0
    return film(world, CAMERA, poses)


def at_middle(flight, sigma_log):
    """Edges of the middle view searched in the other two."""
    views = views_of(flight)
    edges = extract_edges(flight.frames[1].image, 40.0, 100.0, 600)
    u, v = edges.uv.astype(int).T
    truth = flight.depth_m[1][v, u].astype(np.float64)
    others = [views[0], views[2]]
    sigma = np.full(len(truth), sigma_log)
    return edges, truth, measure_edge_depth(views[1], edges.uv, edges.normal, truth, sigma, others, CAMERA)


def test_a_periodic_texture_is_measured_only_with_an_unambiguous_prior():
    """A picket is 10.4 px, a disparity 7.8 px: up to 27 px there are two that look alike, up to 9.5 px only one."""
    _, truth, wide = at_middle(pickets(), 0.5)
    assert len(truth) > 300
    assert np.isfinite(wide.inverse_depth).mean() < 0.2
    _, truth, narrow = at_middle(pickets(), 0.08)
    known = np.isfinite(narrow.inverse_depth)
    assert known.mean() > 0.5
    assert np.median(np.abs(narrow.inverse_depth * truth - 1.0)[known]) < 0.01


def test_sigma_is_half_a_pixel_across_the_edge_worked_by_hand():
    """Cameras that moved by b without turning see an inverse depth at f b: half a pixel of that along the normal."""
    flight = slanted_wall()
    poses = flight.T_w_c.copy()
    moved = film(flight.world, CAMERA, np.stack([poses[2] @ se3.exp(np.r_[b, np.zeros(3)]) for b in BASELINES]))
    edges, _, found = at_middle(moved, 0.35)
    known = np.isfinite(found.inverse_depth)
    assert known.sum() > 100
    across = CAMERA.fx * edges.normal[known] @ np.array(BASELINES)[[0, 2], :2].T.astype(np.float64)
    np.testing.assert_allclose(found.sigma[known], 0.5 / np.sqrt((across**2).sum(1)), rtol=1e-3)


BASELINES = [[0.06, 0.05, 0.0], [0.0, 0.0, 0.0], [-0.05, -0.07, 0.0]]
