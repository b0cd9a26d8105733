"""Flights that tell little of metres: what is stated of them holds."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edgeslam_torch.estimation.config import FusionConfig
from edgeslam_torch.estimation.motion import MotionFusion
from edgeslam_torch.eval.metrics.align import umeyama
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.synthetic.flights.telemetry import simulate

T_B_C = camera_on_body()
STAMPS_S = np.arange(0.0, 24.0, 0.1)


def turning(rng, size_m=0.07):
    """Camera ``(N, 4, 4)`` that turns by half a radian to and fro about each axis and wanders by some centimetres."""
    rate, phase = rng.uniform(0.7, 1.5, (2, 3)), rng.uniform(0.0, 2.0 * np.pi, (2, 3))
    angle, way = (np.sin(np.outer(STAMPS_S, rate[k]) + phase[k]) for k in (0, 1))
    T = np.tile(np.eye(4), (len(STAMPS_S), 1, 1))
    T[:, :3, :3] = Rotation.from_euler("ZYX", 0.5 * angle).as_matrix()
    T[:, :3, 3] = size_m * way + [0.0, 0.0, 1.2]
    return T @ T_B_C


def mapped(rng, T_w_c, growth):
    """The same in a map whose unit changes: ``growth`` ``(N - 1,)`` times the true way from one frame to the next."""
    T = T_w_c.copy()
    steps = growth[:, None] * np.diff(T_w_c[:, :3, 3], axis=0)
    T[1:, :3, 3] = T[0, :3, 3] + np.cumsum(steps, axis=0)
    T[:, :3, 3] += 0.003 * rng.standard_normal((len(T), 3))
    return T


def in_the_end(T_w_c, T_m_c, rng, change=lambda sample: sample, faults=None):
    """Fusion that has seen all of a flight, in its map as it is at last."""
    fusion = MotionFusion(FusionConfig(), T_B_C)
    fusion.add_telemetry([change(s) for s in simulate(rng, STAMPS_S, T_w_c, T_B_C, faults=faults).samples()])
    fusion.add_earlier(STAMPS_S, T_m_c, 0.003, 0.002)
    fusion.revise(STAMPS_S, T_m_c)
    return fusion


def sigmas_off(fusion, T_m_c, T_w_c):
    """Error of the stated scale in its own sigmas, against the similarity that lays the map on the truth."""
    scale = fusion.scale()
    true = umeyama(T_m_c[:, :3, 3], T_w_c[:, :3, 3]).scale
    return abs(math.log(scale.value / true)) * scale.value / scale.sigma


EVEN = np.ones(len(STAMPS_S) - 1)
TORN = np.where(STAMPS_S[1:] < 3.0, 7.0, 1.0)
"""The first three seconds take turns for ways, as maps without parallax do."""


@pytest.mark.parametrize(("growth", "metric"), [(EVEN, True), (TORN, False)], ids=["even", "torn"])
def test_stated_sigma_of_rotation_in_place_covers_the_truth(growth, metric):
    told = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T_w_c = turning(rng)
        T_m_c = mapped(rng, T_w_c, growth)
        fusion = in_the_end(T_w_c, T_m_c, rng)
        told.append(fusion.metres.sensor_scale is not None)
        assert sigmas_off(fusion, T_m_c, T_w_c) < 2.0
        assert metric or any("too badly" in said for said in fusion.warnings())
    assert np.mean(told) >= 0.5 if metric else not any(told)


def test_positions_that_err_with_the_rotation_do_not_pull_the_scale():
    """A map whose depths are off takes a part of each rotation for a translation, the same part whenever it recurs."""
    off = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        T_w_c = turning(rng)
        T_m_c = mapped(rng, T_w_c, EVEN)
        T_m_c[:, :3, 3] += T_w_c[:, :3, :3] @ rng.normal(0.0, 0.04, 3)
        scale = in_the_end(T_w_c, T_m_c, rng).scale()
        off.append(math.log(scale.value) * scale.value / scale.sigma)
    assert np.abs(off).max() < 2.5
    assert np.sqrt(np.mean(np.square(off))) < 1.4
