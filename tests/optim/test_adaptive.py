"""Weights from robust scales: what is measured, and what it does to a window."""

from dataclasses import replace

import numpy as np
import pytest
from seeded_window import Noise, WindowSize, seeded_window

from edgeslam_torch.geometry.robust_statistics import robust_sigma
from edgeslam_torch.optim.adaptive import SCALES, term_residuals, term_sigmas, with_scales

SMALL = WindowSize(poses=6, fixed=2, anchors=200, observations=800, edges=300, pairs=1200, junctions=40)


def at_truth(seed, noise):
    window = seeded_window(seed, SMALL, noise)
    edges, junctions = window.problem.edges, window.problem.junctions
    edges = replace(edges, inverse_depth=window.edge_inverse_depth)
    return replace(window.problem, T_c_w=window.T_c_w, p_w=window.p_w, edges=edges, junctions=junctions)


def test_residuals_of_a_clean_window_are_zero():
    found = term_residuals(at_truth(1, Noise(px=0.0, depth=0.0)))
    assert set(found) == {"reproj", "edge", "cycle", "corner", "angle"}
    for name, r in found.items():
        assert len(r) > 100, name
        assert float(np.abs(r).max()) < 1e-6, name


def test_scales_match_the_added_noise():
    problem = at_truth(2, Noise(px=0.7, depth=0.1))
    found = {k: float(robust_sigma(r)) for k, r in term_residuals(problem).items()}
    assert found["reproj"] == pytest.approx(1.0, abs=0.1)  # whitened by its 0.7 px already
    assert found["edge"] == pytest.approx(0.7, abs=0.1)
    assert found["cycle"] == pytest.approx(0.05, abs=0.01)  # of the log of one depth: half of it


def test_scaled_terms_have_unit_residuals_and_terms_that_are_off_stay_off():
    problem = at_truth(3, Noise(px=0.9, depth=0.1))
    edges = replace(problem.edges, pair_inv_sigma=np.full(len(problem.edges.pair_edge), 0.01))
    problem = replace(problem, edges=edges, junctions=replace(problem.junctions, inv_sigma_angle=0.0))
    r = term_residuals(problem)
    scales = term_sigmas(r) | {name: robust_sigma(found) for name, found in r.items()}
    scaled = with_scales(problem, scales, inflation=2.0)
    assert scaled.edges.pair_inv_sigma[0] * float(robust_sigma(r["edge"])) == pytest.approx(0.5, rel=0.02)
    assert scaled.edges.cycle_sigma == pytest.approx(2.0 * float(robust_sigma(r["cycle"])), rel=0.02)
    assert scaled.junctions.inv_sigma_angle == 0.0
    assert "angle" not in r
    off = replace(problem.edges, cycle_sigma=0.0, pair_inv_sigma=np.zeros(len(problem.edges.pair_edge)))
    off = with_scales(replace(problem, edges=off), scales).edges
    assert off.cycle_sigma == 0.0
    assert not off.pair_inv_sigma.any()


def test_the_papers_pixel_cycle_is_measured_in_pixels():
    problem = at_truth(5, Noise(px=0.0, depth=0.1))
    pixel = replace(problem, edges=replace(problem.edges, cycle_px=True))
    found = term_residuals(pixel)
    assert "cycle" not in found
    assert len(found["cycle px"]) > 1000
    assert with_scales(pixel, term_sigmas({})).edges.cycle_sigma == pytest.approx(SCALES["edge"][0])


def test_a_scale_is_shrunk_to_its_prior_clamped_and_unchanged_by_few_residuals():
    usual = term_sigmas({})
    assert usual == pytest.approx({name: scale[0] for name, scale in SCALES.items()})
    assert term_sigmas({"edge": np.full(10, 9.0)}) == usual
    wild = term_sigmas({"edge": np.full(100, 50.0)})
    assert usual["edge"] < wild["edge"] < SCALES["edge"][2]
    assert wild == term_sigmas({"edge": np.full(100, 500.0)})
    assert wild["reproj"] == usual["reproj"]
