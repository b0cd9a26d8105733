"""What the submap graph says of two places before images compare them."""

import math
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from edgeslam_torch.atlas.submap_graph import Belief, SubmapGraph
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.types import ScaleEstimate


def placed(x):
    return se3.inverse(se3.exp(np.array([x, 0.0, 0.0, 0.0, 0.0, 0.0])))


class World:
    """Keyframe k is at ``x[k]``, in submap ``piece[k]``, and is the reference of frame k. ``also`` are covisible."""

    def __init__(self, x, piece, also=()):
        self.x, self.piece, self.also = x, piece, {frozenset(pair) for pair in also}
        self.keyframes = [SimpleNamespace(id=k, centre_w=np.array([at, 0.0, 0.0])) for k, at in enumerate(x)]
        self.frames = [SimpleNamespace(keyframe_id=k) for k in range(len(x))]
        self.records = self.frames[:1]
        self.lock = nullcontext()

    def support(self):
        return SimpleNamespace(piece=np.array([self.piece[r.keyframe_id] for r in self.records]), supported=True)

    def poses(self):
        return np.zeros(len(self.records)), np.zeros((len(self.records), 4, 4))

    def piece_of(self, id):
        return self.piece[id]

    def pose_of(self, id):
        return placed(self.x[id])

    def covisible(self, keyframe, most):
        near = (k for k in self.keyframes[: keyframe.id] if k.id == keyframe.id - 1 or {k.id, keyframe.id} in self.also)
        return list(near)[:most]

    def graph(self, relative_sigma=0.0, **told):
        return SubmapGraph(self, self, lambda: ScaleEstimate(0.5, 0.5 * relative_sigma, "telemetry"), **told)

    def begin(self, graph, piece, *sigma):
        """A submap begins with the keyframe of its number; then a frame in it follows."""
        graph.begin(piece, self.keyframes[piece], *sigma)
        self.records = self.frames[: piece + 1]


def at(x):
    return np.array([x, 0.0, 0.0])


def test_rotational_uncertainty_grows_with_the_distance_travelled_in_the_submap():
    """Monte Carlo: submaps placed with errors of these sigmas, cameras 3 m along."""
    rng, world = np.random.default_rng(3), World([0.0, 5.0], [0, 1])
    graph = world.graph(0.02)
    world.begin(graph, 1, 0.1, 0.05)
    off = []
    for _ in range(4000):
        T = se3.exp(np.concatenate([np.zeros(3), rng.normal(0.0, 0.05, 3)]))
        grown = math.exp(rng.normal(0.0, 0.02) + rng.normal(0.0, 0.02))
        off.append(rng.normal(0.0, 0.1, 3) + grown * (T[:3, :3] @ at(3.0)) - at(3.0))
    worst_axis = np.sqrt(np.mean(np.square(off), axis=0)).max()
    sigma_t, sigma_r = graph.uncertainty(1, 0, at(8.0))
    assert worst_axis <= sigma_t <= 1.25 * worst_axis
    assert sigma_r == 0.05
    assert graph.uncertainty(0, 1, at(8.0)) == (sigma_t, sigma_r)


def test_uncertainties_of_successive_submaps_add():
    world = World([0.0, 0.0, 2.0], [0, 1, 2])
    graph = world.graph()
    world.begin(graph, 1, 0.3, 0.0)
    world.begin(graph, 2, 0.4, 0.1)
    assert graph.uncertainty(2, 0, at(2.0)) == (pytest.approx(0.5), pytest.approx(0.1))
    assert graph.uncertainty(2, 0, at(5.0))[0] == pytest.approx(math.hypot(0.5, 0.3))
    world.piece = [0, 0, 2]  # the second one was merged
    assert graph.uncertainty(0, 0, at(2.0)) == (0.0, 0.0)


def test_a_submap_without_a_sensor_prediction_is_unrelated():
    world = World([0.0, 1.0], [0, 1])
    graph = world.graph()
    assert graph.uncertainty(1, 0, at(0.0)) == (math.inf, math.inf)
    world.begin(graph, 1, math.inf, math.inf)
    assert graph.uncertainty(1, 0, at(1.0))[0] == math.inf


def test_the_first_submap_of_a_flight_has_no_uncertainty():
    graph = World([0.0], [3]).graph()
    graph.begin(3, graph.map.keyframes[0], 0.1, 0.1)
    assert graph.uncertainty(3, graph.first, at(9.0)) == (0.0, 0.0)


def drifts(world):
    graph = world.graph()
    return [(graph.add(k), graph.path)[1] for k in world.keyframes]


def test_drift_grows_along_the_path_and_a_revisit_shortens_it():
    x = [0.0, 1.0, 2.0, 1.0, 0.2, 1.2]
    assert drifts(World(x, [0] * 6)) == pytest.approx([0.0, 1.0, 2.0, 3.0, 3.8, 4.8])
    assert drifts(World(x, [0] * 6, also=[(0, 4)]))[4:] == pytest.approx([0.2, 1.2])


def test_a_keyframe_without_covisible_ones_keeps_the_last_drift():
    world = World([0.0, 1.0, 2.0], [0] * 3)
    world.covisible = lambda keyframe, most: world.keyframes[:1] if keyframe.id == 1 else []
    assert drifts(world) == pytest.approx([0.0, 1.0, 1.0])


def test_belief_is_a_gate_of_one_percent():
    """Right measurements pass in 99 of 100; each part of the similarity counts."""
    rng, belief = np.random.default_rng(1), Belief(0.2, 0.05, 0.1)
    T_c_w = se3.exp(rng.normal(size=6))
    sigma = np.repeat([0.2, 0.05, 0.1], [3, 3, 1])

    def measured(xi):
        """The similarity that moves the camera by a tangent in its own frame, and scales by another."""
        scale = math.exp(xi[6])
        there = se3.exp(-xi[:6]) @ T_c_w
        return se3.inverse(there) @ sim3.compose(scale, np.eye(3), np.zeros(3)) @ T_c_w

    passed = [belief.allows(measured(rng.normal(0.0, sigma)), T_c_w) for _ in range(2000)]
    assert np.mean(passed) == pytest.approx(0.99, abs=0.008)
    for part in range(7):
        wrong = np.where(np.arange(7) == part, 5.0 * sigma, 0.0)
        assert not belief.allows(measured(wrong), T_c_w)
        assert belief.plus(1.0, 0.5).allows(measured(wrong), T_c_w) == (part < 6)
