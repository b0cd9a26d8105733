import numpy as np
import pytest
from numeric import derivative

from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.optim.pose_graph import PoseGraph, jacobians, residuals, solve

COUNT = 60
STEP = 2 * np.pi / COUNT


def ring():
    """World-to-camera poses ``(N, 4, 4)`` of a camera that flies once around a circle of radius 5 and looks ahead."""
    poses = []
    for angle in STEP * np.arange(COUNT):
        T_w_c = np.eye(4)
        forward, right = np.array([-np.sin(angle), np.cos(angle), 0.0]), np.array([np.cos(angle), np.sin(angle), 0.0])
        T_w_c[:3, :3] = np.stack([right, [0.0, 0.0, -1.0], forward], axis=1)
        T_w_c[:3, 3] = 5.0 * right
        poses.append(se3.inverse(T_w_c))
    return np.stack(poses)


def relative(S, i, j):
    return S[i] @ np.linalg.inv(S[j])


def chain(S):
    """Edges from each node to the one before."""
    i = np.arange(1, len(S))
    return i, i - 1, relative(S, i, i - 1)


def graph_of(S, i, j, S_ij, inv_sigma=None):
    inv_sigma = np.ones((len(i), 7)) if inv_sigma is None else inv_sigma
    return PoseGraph(S, np.array([0]), np.asarray(i), np.asarray(j), S_ij, inv_sigma)


def drifted(S, drift):
    """The chain as it is measured when every step errs by the same small similarity."""
    i, j, S_ij = chain(S)
    return i, j, S_ij, np.stack([sim3.exp(drift) @ one for one in S_ij])


def composed(S_0, steps):
    out = [S_0]
    for step in steps:
        out.append(step @ out[-1])
    return np.stack(out)


def test_true_edges_recover_a_drifted_ring():
    true = ring()
    i, j, S_ij, wrong = drifted(true, np.array([0.01, -0.02, 0.015, 0.004, -0.006, 0.003, 0.01]))
    start = composed(true[0], wrong)
    assert np.linalg.norm(np.linalg.inv(start[-1])[:3, 3] - np.linalg.inv(true[-1])[:3, 3]) > 1.0
    i, j = np.append(i, COUNT - 1), np.append(j, 0)
    S_ij = np.concatenate([S_ij, [relative(true, COUNT - 1, 0)]])
    np.testing.assert_allclose(solve(graph_of(start, i, j, S_ij)), true, atol=1e-6)


def test_a_weaker_edge_takes_more_of_the_correction():
    """Three nodes on a line and a way back that is one unit too short: a sigma twice as large takes four times more."""
    S = np.tile(np.eye(4), (3, 1, 1))
    S[:, 2, 3] = [0.0, -1.0, -2.0]
    i, j, S_ij = chain(S)
    back = np.eye(4)
    back[2, 3] = -1.0
    weight = np.ones((3, 7))
    weight[1] = 0.5
    weight[2] = 1e4
    weight[:, 6] = 1e6  # the scale takes no part
    solved = solve(graph_of(S, np.append(i, 2), np.append(j, 0), np.concatenate([S_ij, [back]]), weight))
    np.testing.assert_allclose(solved[:, 2, 3], [0.0, -0.8, -1.0], atol=1e-6)


def test_jacobians_match_numeric_derivatives(rng):
    count = 6
    S = np.stack([sim3.exp(rng.normal(0.0, 0.6, 7)) for _ in range(count)])
    i, j = np.arange(1, count), np.arange(count - 1)
    noise = [sim3.exp(rng.normal(0.0, 0.15, 7)) for _ in i]
    graph = graph_of(S, i, j, np.stack([n @ relative(S, a, b) for n, a, b in zip(noise, i, j, strict=True)]))
    J_i, J_j = jacobians(graph, residuals(graph, S))

    def with_moved(node, d):
        moved = S.copy()
        moved[node] = sim3.exp(d) @ S[node]
        return residuals(graph, moved)

    for nodes, J in ((i, J_i), (j, J_j)):
        for edge, node in enumerate(nodes):
            numeric = derivative(lambda d, node=node: with_moved(node, d), 7)
            np.testing.assert_allclose(J[edge], numeric[edge], atol=2e-6)


@pytest.mark.parametrize("nodes", [2, 300])
def test_chains_of_any_length_are_solved(nodes, rng):
    S = composed(np.eye(4), [sim3.exp(rng.normal(0.0, 0.1, 7)) for _ in range(nodes - 1)])
    start = S.copy()
    start[1:] = [sim3.exp(rng.normal(0.0, 0.02, 7)) @ one for one in S[1:]]
    np.testing.assert_allclose(solve(graph_of(start, *chain(S))), S, rtol=1e-6, atol=1e-6)
