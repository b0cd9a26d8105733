"""Uncertainty of the pose of a submap that began after a loss."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.estimation.output_frame import OutputFrame
from edgeslam_torch.estimation.prediction import PoseEstimate
from edgeslam_torch.geometry import se3
from edgeslam_torch.states.submap_uncertainty import SubmapUncertainty
from edgeslam_torch.states.system import System
from edgeslam_torch.tracking.motion_model import MotionModel
from edgeslam_torch.types import ScaleEstimate


def test_rotational_uncertainty_grows_with_the_distance_travelled_in_the_submap():
    """Monte Carlo: submaps placed with errors of these sigmas, cameras 3 m along."""
    rng, uncertainty = np.random.default_rng(3), SubmapUncertainty()
    begun, camera = np.array([5.0, 1.0, 1.0]), np.array([8.0, 1.0, 1.0])
    uncertainty.begin(1, 0, begun, 0.1, 0.05)
    off = []
    for _ in range(4000):
        T = se3.exp(np.concatenate([np.zeros(3), rng.normal(0.0, 0.05, 3)]))
        grown = math.exp(rng.normal(0.0, 0.02) + rng.normal(0.0, 0.02))
        placed = begun + rng.normal(0.0, 0.1, 3) + grown * (T[:3, :3] @ (camera - begun))
        off.append(placed - camera)
    worst_axis = np.sqrt(np.mean(np.square(off), axis=0)).max()
    assert uncertainty.sigma(1, camera, 0.02) == pytest.approx(worst_axis, rel=0.25)
    assert uncertainty.sigma(1, camera, 0.02) >= worst_axis


def test_an_aligned_submap_has_the_rotational_uncertainty_of_the_alignment():
    uncertainty = SubmapUncertainty()
    uncertainty.begin(1, 0, np.zeros(3), 0.3, 0.5)
    uncertainty.turned(1, 0.1)
    assert uncertainty.sigma(1, np.array([4.0, 0.0, 0.0]), 0.0) == pytest.approx(0.5)
    uncertainty.turned(2, 0.1)
    assert uncertainty.sigma(2, np.zeros(3), 0.0) == math.inf, "an unrelated submap"


def test_uncertainties_of_successive_submaps_add():
    uncertainty = SubmapUncertainty()
    uncertainty.begin(1, 0, np.zeros(3), 0.3, 0.0)
    uncertainty.begin(2, 1, np.array([0.0, 2.0, 0.0]), 0.4, 0.1)
    assert uncertainty.sigma(2, np.array([0.0, 2.0, 0.0]), 0.0) == pytest.approx(0.5)
    assert uncertainty.sigma(2, np.array([0.0, 5.0, 0.0]), 0.0) == pytest.approx(math.hypot(0.5, 0.3))


def test_an_unrelated_submap_has_infinite_uncertainty():
    assert math.isinf(SubmapUncertainty().sigma(3, np.zeros(3), 0.0))


def system(T_c_w):
    """A system whose frames refer to keyframe 0, with a published scale of 0.5, and the submap of each keyframe."""
    piece_of = {0: 0, 1: 1}
    predicted = PoseEstimate(1.0, se3.inverse(T_c_w), 0.2, 0.01, "filter")
    fusion = SimpleNamespace(
        predict=lambda stamp_s: predicted,
        scale=lambda: ScaleEstimate(0.5, 0.01, "telemetry"),
        add_visual=lambda *_: None,
        republished=lambda published, _, held: published if held else replace(published, scale=0.5, guessed=False),
    )
    slam_map = SimpleNamespace(piece=1, piece_of=piece_of.__getitem__)
    made = System(None, None, slam_map, None, None, None, None, fusion, MotionModel(T_c_w), OutputFrame(0.5))
    made.log = SimpleNamespace(records=[SimpleNamespace(keyframe_id=0)])
    return made, piece_of


def placed(x):
    return se3.inverse(se3.exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])))


def see(made, T_c_w):
    made.motion.T_c_w = T_c_w
    made.see(2.0, SimpleNamespace(T_c_w=T_c_w, covariance=1e-6 * np.eye(6)))
    return made.submap_sigma


def test_uncertainty_is_published_in_output_units_until_the_submaps_are_merged():
    made, piece_of = system(placed(4.0))
    assert see(made, placed(4.0)) == 0.0
    made.begin_submap(1, 1.0)
    assert made.submap_sigma == pytest.approx(0.5 * 0.2)
    made.log.records.append(SimpleNamespace(keyframe_id=1))
    way = 3.0 * math.hypot(0.01, math.sqrt(2.0) * 0.02)
    assert see(made, placed(7.0)) == pytest.approx(0.5 * math.hypot(0.2, way))
    piece_of[1] = 0  # joined
    assert see(made, placed(7.0)) == 0.0


def test_the_first_submap_has_no_uncertainty():
    made, _ = system(np.eye(4))
    made.log.records.clear()
    made.begin_submap(0, 0.0)
    assert made.submap_sigma == 0.0


@pytest.mark.parametrize(
    ("first", "now", "is_of_the_piece"),
    [
        (ScaleEstimate(0.6, 0.012, "telemetry"), ScaleEstimate(0.5, 0.01, "telemetry+height"), True),
        (ScaleEstimate(0.6, 0.07, "height"), ScaleEstimate(0.5, 0.01, "telemetry+height"), False),
        (ScaleEstimate(0.6, np.inf, "none"), ScaleEstimate(0.5, 0.01, "telemetry+height"), False),
        (ScaleEstimate(0.52, 0.012, "telemetry"), ScaleEstimate(0.5, 0.01, "telemetry+height"), False),
    ],
    ids=["both certain", "first uncertain", "first unknown", "equal"],
)
def test_a_different_scale_in_a_later_submap_belongs_to_that_submap(first, now, is_of_the_piece):
    """Applied to the whole map, it would falsify the scale of all earlier output."""
    made, piece_of = system(placed(4.0))
    made.fusion.scale = lambda: first
    made.published = OutputFrame(0.6, guessed=False)
    see(made, placed(4.0))
    made.published = OutputFrame(0.6, guessed=False)
    made.begin_submap(1, 1.0)
    made.log.records.append(SimpleNamespace(keyframe_id=1))
    made.fusion.scale = lambda: now
    made.begin_submap(2, 1.5)  # from a later one: nothing new of the first
    see(made, placed(7.0))
    assert made.published.scale == (0.6 if is_of_the_piece else 0.5)
    if is_of_the_piece:
        assert made.scale_ratio() == pytest.approx((0.5 / 0.6, math.hypot(0.02, 0.02)))
        made.submap_uncertainty.moved(1, 3.0)
        assert made.scale_ratio()[0] == pytest.approx(0.5 / 0.6), "the first submap is unchanged"
        made.submap_uncertainty.moved(0, 1.1)
        assert made.scale_ratio()[0] == pytest.approx(1.1 * 0.5 / 0.6), "it was merged into a later one, and grew"
    piece_of[1] = 0  # joined
    assert made.scale_ratio() is None
    see(made, placed(7.0))
    assert made.published.scale == 0.5, "after merging it applies to the whole map"
