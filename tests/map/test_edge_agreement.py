"""How far keyframes disagree about the depth of the same edges: against errors that were put in."""

import numpy as np
import pytest

from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.edge_agreement import DEFAULT_BEND, SHARED, View, bend

CAMERA = Camera(640, 480, 400.0, 400.0, 319.5, 239.5)


def flight(rng, errors, gap=0.05, edges=600):
    """Views of one wall of posts from a camera that moves aside; all depths of a view are off by its log error."""
    p_w = np.c_[rng.uniform(-3, 3, edges), rng.uniform(-1, 1, edges), rng.uniform(2.0, 4.0, edges)]
    views = []
    for i, error in enumerate(errors):
        T_w_c = np.eye(4)
        T_w_c[0, 3] = gap * i
        p_c = p_w - T_w_c[:3, 3]
        uv = CAMERA.project(p_c)
        inside = (uv >= 5).all(1) & (uv < [635, 475]).all(1)
        views.append(View(T_w_c, uv[inside], p_c[inside] * np.exp(error)))
    return views


@pytest.mark.parametrize("sigma", [0.004, 0.02])
def test_drift_between_views_is_found(rng, sigma):
    errors = sigma * rng.standard_normal(60)
    assert bend(flight(rng, errors), CAMERA) == pytest.approx(SHARED * sigma, rel=0.25)


def test_neighbouring_keyframes_are_not_compared(rng):
    """Three keyframes that were refined together agree, whatever the drift from those three to the next three."""
    errors = np.repeat([0.0, 0.02, 0.04, 0.06], 3)
    apart = np.abs(np.subtract.outer(np.arange(12), np.arange(12))) >= 3
    expected = np.median(np.abs(np.subtract.outer(errors, errors))[apart]) / 0.6745 / np.sqrt(2)
    assert bend(flight(rng, errors, gap=0.01), CAMERA) == pytest.approx(SHARED * expected, rel=0.1)


def test_mismatched_edges_are_ignored(rng):
    views = flight(rng, 0.01 * rng.standard_normal(40))
    right = bend(views, CAMERA)
    for view in views:
        some = rng.permutation(len(view.p_c))[: len(view.p_c) // 5]
        view.p_c[some] *= rng.uniform(0.5, 2.0, (len(some), 1))
    assert bend(views, CAMERA) == pytest.approx(right, rel=0.3)


@pytest.mark.parametrize("case", ["none", "neighbours", "opposite"])
def test_without_overlap_the_default_applies(rng, case):
    views = flight(rng, 0.1 * rng.standard_normal(12))
    if case == "none":
        views = []
    elif case == "neighbours":
        views = views[:3]
    else:
        for i, view in enumerate(views):
            turn = np.deg2rad(90.0 * i)
            view.T_w_c[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        views = views[:4]
    assert bend(views, CAMERA) == DEFAULT_BEND


@pytest.mark.parametrize(("common", "most"), [(0.0, 1e-6), (0.1, 0.01)])
def test_consistent_views_have_no_drift_and_a_common_error_is_unobservable(rng, common, most):
    """Which is why `SHARED` is more than one."""
    assert bend(flight(rng, np.full(20, common)), CAMERA) < most
