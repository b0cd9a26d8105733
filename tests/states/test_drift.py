"""Drift of a map from the length of its covisibility path."""

from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.states.drift import Drift


class Chain:
    """Keyframes along x with one metre spacing; each is covisible with its neighbours and with given others."""

    def __init__(self, also=()):
        self.keyframes, self.also = [], {frozenset(pair) for pair in also}

    def covisible(self, keyframe, most):
        near = [k for k in self.keyframes if abs(k.id - keyframe.id) == 1 or {k.id, keyframe.id} in self.also]
        return near[:most]

    def grow(self, drift, x):
        keyframe = SimpleNamespace(id=len(self.keyframes), centre_w=np.array([x, 0.0, 0.0]))
        self.keyframes.append(keyframe)
        drift.add(self, keyframe)
        return drift.newest


def test_drift_grows_along_the_path():
    drift, chain = Drift(), Chain()
    assert [chain.grow(drift, x) for x in (0.0, 1.0, 2.0, 1.0, 0.0)] == pytest.approx([0.0, 1.0, 2.0, 3.0, 4.0])


def test_a_revisit_shortens_the_path():
    drift, chain = Drift(), Chain(also=[(0, 4)])
    assert [chain.grow(drift, x) for x in (0.0, 1.0, 2.0, 1.0, 0.2, 1.2)][4:] == pytest.approx([0.2, 1.2])


def test_a_keyframe_without_covisible_ones_keeps_the_last_drift():
    drift, chain = Drift(), Chain()
    for x in (0.0, 1.0, 2.0):
        chain.grow(drift, x)
    chain.covisible = lambda keyframe, most: []
    assert chain.grow(drift, 9.0) == pytest.approx(2.0)
