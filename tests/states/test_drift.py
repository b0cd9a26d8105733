"""What a map may have drifted by: by the way to what it knows."""

from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.states.drift import Drift


class Chain:
    """Keyframes a metre apart along x, each of which sees what its neighbours see, and what else is said."""

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


def test_it_grows_with_the_way_there_and_back():
    drift, chain = Drift(), Chain()
    assert [chain.grow(drift, x) for x in (0.0, 1.0, 2.0, 1.0, 0.0)] == pytest.approx([0.0, 1.0, 2.0, 3.0, 4.0])


def test_it_is_short_again_where_a_place_is_known_again():
    drift, chain = Drift(), Chain(also=[(0, 4)])
    assert [chain.grow(drift, x) for x in (0.0, 1.0, 2.0, 1.0, 0.2, 1.2)][4:] == pytest.approx([0.2, 1.2])


def test_what_sees_nothing_known_has_drifted_as_what_was_before():
    drift, chain = Drift(), Chain()
    for x in (0.0, 1.0, 2.0):
        chain.grow(drift, x)
    chain.covisible = lambda keyframe, most: []
    assert chain.grow(drift, 9.0) == pytest.approx(2.0)
