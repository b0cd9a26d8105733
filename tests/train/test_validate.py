"""Scores of a network that is wrong by a known factor."""

import numpy as np
import pytest
import torch
from small_depth import METADATA, VIEW, small_depth

from edgeslam_torch.errors import SourceError
from edgeslam_torch.models.trainable import Prediction
from edgeslam_torch.train.validate import contradiction, coverage, score
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.train.views.datasets import DepthFolder


def two_metres(x):
    return Prediction(torch.full((len(x), 1, *x.shape[-2:]), float(np.log(2.0))), None)


def test_depth_out_of_range_does_not_count():
    network = small_depth()
    network.predict = two_metres
    depth = np.full((32, 64), 2.5, np.float32)
    depth[:8], depth[8:16] = 0.05, 12.0
    found = score(network, METADATA, [View(VIEW.image, depth, VIEW.K)])
    assert (found.abs_rel, found.rmse_m) == pytest.approx((0.2, 0.5), abs=1e-5)
    assert found.abs_rel_scaled == pytest.approx(0.0, abs=1e-5) and found.delta1_scaled == 1.0
    assert np.isnan(found.abs_rel_edges) and "abs_rel_edges" not in found.metrics()
    with pytest.raises(SourceError, match="no depth between"):
        score(network, METADATA, [View(VIEW.image, np.full_like(depth, 12.0), VIEW.K)])


def test_coverage_of_a_normal_sigma_is_nominal(rng):
    sigma = rng.uniform(0.05, 0.4, 20000)
    one, two = coverage(rng.normal(0, sigma), sigma)
    assert one == pytest.approx(0.683, abs=0.02)
    assert two == pytest.approx(0.95, abs=0.01)


def test_labels_in_another_unit_or_order_contradict_the_network():
    network = small_depth()
    ramp = torch.linspace(1.0, 4.0, 64)
    network.predict = lambda x: Prediction(ramp.log().expand(len(x), 1, *x.shape[-2:]), None)
    truth = np.tile(ramp.numpy(), (32, 1))

    def said(depth):
        views = [View(VIEW.image, depth.astype(np.float32), VIEW.K)] * 3
        return contradiction(network, METADATA, DepthFolder("kitchen", views, ()))

    assert said(truth) == said(1.5 * truth) == said(np.where(truth > 2, truth, 0)) == ""
    assert "0.2 times" in said(0.2 * truth)
    assert "disparities" in said(2.0 / truth)
    with pytest.raises(SourceError, match="no depth"):
        said(np.zeros_like(truth))
