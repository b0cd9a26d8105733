"""The losses of a window are those of the loss modules."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from seeded_window import Noise, WindowSize, seeded_window

from edgeslam_torch.losses import AngleLoss, CycleLoss, EdgeAlignmentLoss, ReprojectionLoss
from edgeslam_torch.losses.cycle import CycleForm
from edgeslam_torch.optim.adaptive import window_losses
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.problem import LmConfig, WindowProblem
from edgeslam_torch.optim.window import refined

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
        edges=replace(
            edges, cycle_px=form is CycleForm.PIXEL, cycle_sigma=0.5, prior_sigma=np.full(len(edges.host), np.inf)
        ),
        junctions=replace(
            junctions,
            cosines=True,
            inv_sigma_px=0.0,
            inv_sigma_angle=3.0,
            prior_information=np.zeros_like(junctions.prior_information),
        ),
    )


@pytest.mark.parametrize("form", FORMS)
def test_losses_are_the_modules_mean_squares(form):
    problem = noisy(form)
    K = torch.tensor([[problem.K[0], 0.0, problem.K[2]], [0.0, problem.K[1], problem.K[3]], [0.0, 0.0, 1.0]]).double()
    T, p, uv, seen = (
        torch.as_tensor(x) for x in (problem.T_c_w, problem.p_w, np.full((6, 100, 2), np.nan), problem.uv)
    )
    uv[problem.obs_pose, problem.obs_anchor] = seen
    losses = window_losses(problem)
    assert losses["reprojection_px2"] == pytest.approx(float(ReprojectionLoss()(T, p, uv, K)), rel=1e-9)
    e = problem.edges
    assert e is not None
    at = e.pair_edge
    motion = T[e.pair_pose] @ torch.linalg.inv(T)[e.host[at]]
    pixel, depth, depth_j = (
        torch.as_tensor(x)[:, None] for x in (e.uv[at], 1.0 / e.inverse_depth[at], 1.0 / e.pair_inverse_depth)
    )
    partner = torch.as_tensor(e.pair_uv)[:, None], torch.as_tensor(e.pair_normal)[:, None]
    alignment = EdgeAlignmentLoss()(motion, pixel, depth, *partner, K)
    assert losses["alignment_px2"] == pytest.approx(float(alignment.mean()), rel=1e-9)
    cycle = CycleLoss(form, max_relative=float("inf"))(motion, pixel, depth, depth_j, K)
    name = "cycle" if form is CycleForm.RELATIVE_DEPTH else "cycle_px2"
    assert losses[name] == pytest.approx(float(cycle.mean()), rel=1e-9)
    j = problem.junctions
    assert j is not None
    motion = T[j.pair_pose] @ torch.linalg.inv(T)[j.host[j.pair_junction]]
    pixel, depth = (torch.as_tensor(x)[j.pair_junction][:, None] for x in (j.uv, 1.0 / j.inverse_depth))
    cosine = torch.as_tensor((j.pair_arms[:, 0] * j.pair_arms[:, 1]).sum(1))[:, None]
    assert losses["angle"] == pytest.approx(float(AngleLoss()(motion, pixel, depth, cosine, K).mean()), rel=1e-9)
    assert losses["total"] > 0.0


def test_refinement_lowers_every_loss_of_a_disturbed_window():
    problem = noisy(CycleForm.RELATIVE_DEPTH)
    result = refine_window(problem, LmConfig(max_iterations=20))
    before, after = window_losses(problem), window_losses(refined(problem, result))
    assert all(after[name] < before[name] for name in before if name != "total")


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
