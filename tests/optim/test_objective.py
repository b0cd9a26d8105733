"""The solver's kernels minimise what the loss modules define."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from edgeslam_torch.losses.base import Reduction, reduce
from edgeslam_torch.losses.cycle import CycleForm
from edgeslam_torch.losses.robust import Kernel
from edgeslam_torch.optim.adaptive import term_residuals
from edgeslam_torch.optim.benchmark import Noise, WindowSize, seeded_window
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.objective import refined, window_losses, window_residuals
from edgeslam_torch.optim.problem import LmConfig, WindowProblem

SMALL = WindowSize(poses=6, fixed=2, anchors=100, observations=400, edges=150, pairs=500, junctions=30)
FORMS = [CycleForm.RELATIVE_DEPTH, CycleForm.PIXEL]


def noisy(form: CycleForm) -> WindowProblem:
    """A window with every term and no prior, where the paper's cosine stands for the angle."""
    problem = seeded_window(5, SMALL, Noise(px=0.7)).problem
    edges, junctions = problem.edges, problem.junctions
    assert edges is not None and junctions is not None
    return replace(
        problem,
        scale_priors=(),
        inv_sigma=np.ones(len(problem.obs_pose)),
        edges=replace(edges, cycle=form, cycle_sigma=0.5, prior_sigma=np.full(len(edges.host), np.inf)),
        junctions=replace(
            junctions,
            cosines=True,
            inv_sigma_px=0.0,
            inv_sigma_angle=3.0,
            prior_information=np.zeros_like(junctions.prior_information),
        ),
    )


@pytest.mark.parametrize("form", FORMS)
def test_kernels_give_the_modules_residuals(form):
    problem = noisy(form)
    fast = term_residuals(problem)
    names = {"reprojection_px2": "reproj", "alignment_px2": "edge", "angle": "angle"}
    names |= {"cycle": "cycle"} if form is CycleForm.RELATIVE_DEPTH else {"cycle_px2": "cycle px"}
    modules = window_residuals(problem)
    assert set(modules) == set(names)
    for module, kernel in names.items():
        value = modules[module].value[modules[module].valid].flatten().sort().values
        torch.testing.assert_close(value, fast[kernel].flatten().sort().values)
        assert float(value.abs().max()) > 1e-3, "noise in every term"


@pytest.mark.parametrize("form", FORMS)
def test_solver_minimises_the_modules_sum_of_squares(form):
    problem = noisy(form)
    cost = refine_window(problem, LmConfig(max_iterations=0, kernel=Kernel.L2, diagnostics=False)).cost_before
    sums = {name: float(reduce(r, Reduction.SUM)) for name, r in window_residuals(problem).items()}
    edges, junctions = problem.edges, problem.junctions
    assert edges is not None and junctions is not None
    sums["alignment_px2"] *= float(edges.pair_inv_sigma[0]) ** 2
    sums["cycle" if form is CycleForm.RELATIVE_DEPTH else "cycle_px2"] /= edges.cycle_sigma**2
    sums["angle"] *= junctions.inv_sigma_angle**2
    assert cost == pytest.approx(sum(sums.values()), rel=1e-6)


def test_refinement_lowers_every_loss_of_a_disturbed_window():
    problem = noisy(CycleForm.RELATIVE_DEPTH)
    result = refine_window(problem, LmConfig(max_iterations=20))
    before, after = window_losses(problem), window_losses(refined(problem, result))
    assert all(after[name] < before[name] for name in before if name != "total")
    unknowns, numbers = 3 * SMALL.anchors + 6 * (SMALL.poses - SMALL.fixed), 2 * SMALL.observations
    assert after["reprojection_px2"] == pytest.approx(2 * 0.7**2 * (1 - unknowns / numbers), rel=0.15)


def test_terms_that_are_off_are_left_out():
    problem = noisy(CycleForm.RELATIVE_DEPTH)
    assert problem.edges is not None
    edges = replace(problem.edges, cycle_sigma=0.0)
    assert set(window_losses(replace(problem, edges=edges, junctions=None))) == {
        "reprojection_px2",
        "alignment_px2",
        "total",
    }
    none = np.zeros(0, dtype=np.int64)
    empty = replace(problem, edges=None, junctions=None, obs_pose=none, obs_anchor=none, uv=np.zeros((0, 2)))
    assert window_losses(empty) == {}


def test_edges_of_unknown_depth_do_not_count():
    problem = noisy(CycleForm.RELATIVE_DEPTH)
    assert problem.edges is not None
    depth = problem.edges.inverse_depth.copy()
    depth[:10] = 0.0
    far = replace(problem, edges=replace(problem.edges, inverse_depth=depth))
    residuals = window_residuals(far)["alignment_px2"]
    assert int((~residuals.valid).sum()) == int((problem.edges.pair_edge < 10).sum()) > 0
    assert all(np.isfinite(value) for value in window_losses(far).values())
