"""Sensitivity and invariances of the cycle loss."""

import numpy as np
import torch

from edgeslam_torch.geometry import se3_torch as lie
from edgeslam_torch.losses.base import back_project, move, project
from edgeslam_torch.losses.cycle import CycleForm, CycleLoss, sample_depth

K = torch.tensor([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def plane_world():
    """A camera that moves in front of a slanted wall; exact depth maps of both views."""
    v, u = torch.meshgrid(torch.arange(480.0), torch.arange(640.0), indexing="ij")
    rays = back_project(torch.stack((u, v), -1).double(), torch.ones(480, 640, dtype=torch.float64), K)
    normal = torch.tensor([0.2, -0.1, 1.0], dtype=torch.float64)
    depth_i = 3.0 / (rays @ normal)
    T = lie.exp(torch.tensor([0.25, 0.05, 0.1, 0.01, -0.03, 0.02], dtype=torch.float64))
    n_j = T[:3, :3] @ normal
    depth_j = (3.0 + n_j @ T[:3, 3]) / (rays @ n_j)
    return T, depth_i, depth_j


def test_literal_falls_with_the_baseline_and_the_corrected_forms_do_not(rng):
    T, depth_i, depth_j = plane_world()
    uv = torch.tensor(rng.integers((150, 150), (490, 330), (200, 2)), dtype=torch.float64)
    d = depth_i[uv[:, 1].long(), uv[:, 0].long()] * torch.tensor(rng.uniform(0.9, 1.1, 200))  # network noise
    shrunk = T.clone()
    shrunk[:3, 3] *= 0.5
    ratio = {}
    for form in CycleForm:
        loss = CycleLoss(form, max_relative=9.0, min_parallax_px=0.0)
        ratio[form] = float(loss(shrunk, uv, d, depth_j, K) / loss(T, uv, d, depth_j, K))
    assert ratio[CycleForm.PIXEL] < 0.5  # halving the baseline pays
    assert ratio[CycleForm.PARALLAX] > 0.9
    assert ratio[CycleForm.RELATIVE_DEPTH] > 0.9


def test_occluded_and_outside_edges_are_masked():
    T, depth_i, depth_j = plane_world()
    near = depth_j.clone()
    near[:, 320:] *= 0.5  # something stands in front of the right half in frame j
    uv = torch.tensor([[200.0, 240.0], [450.0, 240.0], [639.0, 479.0]], dtype=torch.float64)
    d = depth_i[uv[:, 1].long(), uv[:, 0].long()]
    assert CycleLoss().residuals(T, uv, d, near, K).valid.tolist() == [True, False, False]
    assert CycleLoss.literal().residuals(T, uv, d, near, K).valid.tolist() == [True, True, False]


def test_edges_without_depth_do_not_count_although_a_camera_that_moved_back_has_them_before_it():
    T = lie.exp(torch.tensor([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], dtype=torch.float64))
    uv = torch.tensor([[300.0, 200.0], [310.0, 200.0]], dtype=torch.float64)
    d_i, d_j = torch.tensor([[2.0, 0.0], [2.5, 0.5]], dtype=torch.float64)
    assert CycleLoss().residuals(T, uv, d_i, d_j, K).valid.tolist() == [True, False]


def test_pixels_go_the_way_of_the_equations():
    T, depth_i, depth_j = plane_world()
    uv = torch.tensor([[300.0, 200.0]], dtype=torch.float64)
    d_i, d_j = torch.tensor([2.0], dtype=torch.float64), torch.tensor([2.5], dtype=torch.float64)
    uv_j, _ = project(move(T, back_project(uv, d_i, K)), K)
    expected, _ = project(move(lie.inverse(T), back_project(uv_j, d_j, K)), K)
    loss = CycleLoss(CycleForm.PIXEL, max_relative=9.0)
    torch.testing.assert_close(loss.residuals(T, uv, d_i, d_j, K).value, expected - uv)


def test_sampling_interpolates_and_marks_the_outside():
    depth = torch.tensor([[1.0, 2.0], [3.0, 4.0]], dtype=torch.float64)
    uv = torch.tensor([[0.0, 0.0], [1.0, 1.0], [0.5, 0.5], [-0.1, 0.0], [0.0, 1.01]], dtype=torch.float64)
    d, inside = sample_depth(depth, uv)
    assert inside.tolist() == [True, True, True, False, False]
    np.testing.assert_allclose(d[:3].numpy(), [1.0, 4.0, 2.5])
