"""How well it is known where a piece of map lies that began after a loss."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.fusion.output_frame import OutputFrame
from edgeslam_torch.fusion.prediction import PoseEstimate
from edgeslam_torch.geometry import se3
from edgeslam_torch.states.submap_uncertainty import Apart
from edgeslam_torch.states.system import System
from edgeslam_torch.tracking.motion_model import MotionModel
from edgeslam_torch.types import ScaleEstimate


def test_a_turn_that_is_not_known_counts_by_the_way_flown_in_the_piece():
    """Against the truth: pieces laid down with errors of these sigmas, cameras 3 m along."""
    rng, apart = np.random.default_rng(3), Apart()
    begun, camera = np.array([5.0, 1.0, 1.0]), np.array([8.0, 1.0, 1.0])
    apart.begin(1, 0, begun, 0.1, 0.05)
    off = []
    for _ in range(4000):
        T = se3.exp(np.concatenate([np.zeros(3), rng.normal(0.0, 0.05, 3)]))
        grown = math.exp(rng.normal(0.0, 0.02) + rng.normal(0.0, 0.02))
        placed = begun + rng.normal(0.0, 0.1, 3) + grown * (T[:3, :3] @ (camera - begun))
        off.append(placed - camera)
    worst_axis = np.sqrt(np.mean(np.square(off), axis=0)).max()
    assert apart.sigma(1, camera, 0.02) == pytest.approx(worst_axis, rel=0.25)
    assert apart.sigma(1, camera, 0.02) >= worst_axis


def test_a_piece_that_was_turned_is_as_sure_of_its_heading_as_what_told_it():
    apart = Apart()
    apart.begin(1, 0, np.zeros(3), 0.3, 0.5)
    apart.turned(1, 0.1)
    assert apart.sigma(1, np.array([4.0, 0.0, 0.0]), 0.0) == pytest.approx(0.5)
    apart.turned(2, 0.1)
    assert apart.sigma(2, np.zeros(3), 0.0) == math.inf, "a piece that nothing relates"


def test_a_piece_after_another_is_in_doubt_by_both():
    apart = Apart()
    apart.begin(1, 0, np.zeros(3), 0.3, 0.0)
    apart.begin(2, 1, np.array([0.0, 2.0, 0.0]), 0.4, 0.1)
    assert apart.sigma(2, np.array([0.0, 2.0, 0.0]), 0.0) == pytest.approx(0.5)
    assert apart.sigma(2, np.array([0.0, 5.0, 0.0]), 0.0) == pytest.approx(math.hypot(0.5, 0.3))


def test_what_nothing_relates_is_anywhere():
    assert math.isinf(Apart().sigma(3, np.zeros(3), 0.0))


def system(T_c_w):
    """A system whose frames are tied to keyframe 0, in a published unit of two map units, and what piece it is in."""
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
    return made.apart_sigma


def test_a_system_states_it_in_the_published_unit_until_the_pieces_are_one():
    made, piece_of = system(placed(4.0))
    assert see(made, placed(4.0)) == 0.0
    made.carried_to(1, 1.0)
    assert made.apart_sigma == pytest.approx(0.5 * 0.2)
    made.log.records.append(SimpleNamespace(keyframe_id=1))
    way = 3.0 * math.hypot(0.01, math.sqrt(2.0) * 0.02)
    assert see(made, placed(7.0)) == pytest.approx(0.5 * math.hypot(0.2, way))
    piece_of[1] = 0  # joined
    assert see(made, placed(7.0)) == 0.0


def test_the_first_piece_is_carried_from_nowhere():
    made, _ = system(np.eye(4))
    made.log.records.clear()
    made.carried_to(0, 0.0)
    assert made.apart_sigma == 0.0


@pytest.mark.parametrize(
    ("first", "now", "is_of_the_piece"),
    [
        (ScaleEstimate(0.6, 0.012, "telemetry"), ScaleEstimate(0.5, 0.01, "telemetry+height"), True),
        (ScaleEstimate(0.6, 0.07, "height"), ScaleEstimate(0.5, 0.01, "telemetry+height"), False),
        (ScaleEstimate(0.6, np.inf, "none"), ScaleEstimate(0.5, 0.01, "telemetry+height"), False),
        (ScaleEstimate(0.52, 0.012, "telemetry"), ScaleEstimate(0.5, 0.01, "telemetry+height"), False),
    ],
    ids=["sure of both", "unsure of the first one", "nothing known of it", "the same"],
)
def test_what_tells_another_unit_in_a_later_piece_is_of_that_piece(first, now, is_of_the_piece):
    """`blank_walls` 815: all that the drone had flown before was published 11 % too short, with 2 % stated."""
    made, piece_of = system(placed(4.0))
    made.fusion.scale = lambda: first
    made.published = OutputFrame(0.6, guessed=False)
    see(made, placed(4.0))
    made.published = OutputFrame(0.6, guessed=False)
    made.carried_to(1, 1.0)
    made.log.records.append(SimpleNamespace(keyframe_id=1))
    made.fusion.scale = lambda: now
    made.carried_to(2, 1.5)  # from a later one: nothing new of the first
    see(made, placed(7.0))
    assert made.published.scale == (0.6 if is_of_the_piece else 0.5)
    if is_of_the_piece:
        assert made.other_unit() == pytest.approx((0.5 / 0.6, math.hypot(0.02, 0.02)))
        made.apart.moved(1, 3.0)
        assert made.other_unit()[0] == pytest.approx(0.5 / 0.6), "the first one stayed"
        made.apart.moved(0, 1.1)
        assert made.other_unit()[0] == pytest.approx(1.1 * 0.5 / 0.6), "it was joined to a later one, and grew"
    piece_of[1] = 0  # joined
    assert made.other_unit() is None
    see(made, placed(7.0))
    assert made.published.scale == 0.5, "now it is of all of the map"
