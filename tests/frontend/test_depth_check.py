"""Implausible depth maps count as missing."""

import logging

import numpy as np
import pytest
from rendered import CAMERA

from edgeslam_torch.frontend.depth_check import CheckedDepth, usable
from edgeslam_torch.types import DepthMap

IMAGE = np.zeros((240, 320, 3), np.uint8)


def depth_map(metres, sigma=0.2):
    return DepthMap(np.full((240, 320), metres, np.float32), np.full((240, 320), sigma, np.float32))


@pytest.mark.parametrize(
    ("metres", "sigma"),
    [(np.nan, 0.2), (np.inf, 0.2), (0.0, 0.2), (-2.0, 0.2), (0.01, 0.2), (1000.0, 0.2),
     (2.0, np.nan), (2.0, np.inf), (2.0, 0.0), (2.0, -0.1), (2.0, 1e30)],
)  # fmt: skip
def test_an_implausible_map_is_rejected(metres, sigma):
    checked = CheckedDepth(lambda image, camera: depth_map(metres, sigma))
    assert checked(IMAGE, CAMERA) is None
    assert checked.refused == checked.maps == 1


def test_single_bad_pixels_become_unknown_and_the_rest_stays():
    depth = depth_map(2.0)
    depth.depth_m[:100] = np.inf
    depth.sigma_log[100:110] = np.nan
    found = CheckedDepth(lambda image, camera: depth)(IMAGE, CAMERA)
    assert found is not None
    assert np.isnan(found.depth_m[:110]).all()
    assert (found.depth_m[110:] == 2.0).all()
    assert np.isinf(depth.depth_m[:100]).all(), "the caller's own map is left alone"
    assert usable(found).mean() == pytest.approx(130 / 240)


def test_rejections_give_one_warning_with_their_count(caplog):
    maps = iter([depth_map(2.0), *[depth_map(np.nan)] * 5, depth_map(3.0)])
    checked = CheckedDepth(lambda image, camera: next(maps))
    with caplog.at_level(logging.WARNING):
        answers = [checked(IMAGE, CAMERA) for _ in range(7)]
    assert [a is None for a in answers] == [False, *[True] * 5, False]
    assert len(caplog.records) == 1
    assert "unusable for 5 of 7 keyframes" in str(checked.warning())


class Described:
    """A network whose description a reference contradicts in some of its maps."""

    reference = staticmethod(lambda image, camera: depth_map(2.0))

    def __init__(self, contradicted):
        self.contradicted = iter(contradicted)

    def __call__(self, image, camera):
        return depth_map(3.0)

    def contradiction(self, depth, image, camera, reference):
        return "gives = 'metres'" if next(self.contradicted) else ""


def test_contradicted_depth_is_rejected_with_one_warning(caplog):
    checked = CheckedDepth(Described([True] * 5))
    with caplog.at_level(logging.WARNING):
        assert [checked(IMAGE, CAMERA) for _ in range(8)] == [None] * 8
    assert len(caplog.records) == 1
    assert "gives = 'metres'" in (checked.warning() or "")


def test_most_maps_decide_whether_depth_is_rejected():
    checked = CheckedDepth(Described([True, False, False, True, False]))
    assert [checked(IMAGE, CAMERA) is None for _ in range(8)] == [True, *[False] * 7]
    assert checked.warning() is None


@pytest.mark.parametrize("metres", [0.05, 0.3, 10.0, 100.0, 200.0])
def test_a_plausible_map_passes_untouched(metres):
    depth = depth_map(metres)
    checked = CheckedDepth(lambda image, camera: depth)
    assert checked(IMAGE, CAMERA) is depth
    assert checked.warning() is None


def test_a_map_of_mostly_bad_pixels_is_rejected():
    depth = depth_map(2.0)
    depth.depth_m[:121] = np.nan
    assert CheckedDepth(lambda image, camera: depth)(IMAGE, CAMERA) is None
