"""Edge and junction terms made from keyframes, and what they do for a window."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numeric import edges_along, pixels

from edgeslam_torch.frontend.corners import Junctions
from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.edge_association import edge_field
from edgeslam_torch.mapping.window_terms import (
    Structure,
    TermConfig,
    collinearity_prior,
    edge_terms,
    junction_terms,
    make_structure,
    nearest_poses,
)
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.problem import LmConfig, WindowProblem
from edgeslam_torch.types import FloatArray

K = (500.0, 500.0, 319.5, 239.5)
SIZE = (640, 480)


def corners(rng: np.random.Generator, count: int = 40) -> FloatArray:
    """Corner and two arm ends of right angles in space ``(C, 3, 3)``."""
    p = rng.uniform((-1.6, -1.1, 3), (1.6, 1.1, 5), (count, 3))
    a = rng.normal(size=(count, 3)) * np.array([1, 1, 0.3])
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b = np.cross(a, np.array([0.0, 0.0, 1.0]))
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    return np.stack([p, p + 0.4 * a, p + 0.4 * b], 1)


def see(T: FloatArray, world: FloatArray) -> Structure:
    """What a keyframe would extract of the corners."""
    s = np.linspace(0, 1, 80)[:, None]
    arms = (world[:, :1, None] * (1 - s) + world[:, 1:, None] * s).reshape(-1, 3)
    p = se3.transform(T, arms)
    ends = pixels(se3.transform(T, world.reshape(-1, 3)), K).reshape(-1, 3, 2)
    arms_2d = ends[:, 1:] - ends[:, :1]
    edges, which = edges_along(pixels(p, K), np.repeat(arms_2d.reshape(-1, 2), 80, 0), SIZE)
    inverse_depth = 1.0 / p[which, 2]
    length = np.linalg.norm(arms_2d, axis=2)
    arms_2d = arms_2d / length[..., None]
    left = arms_2d[:, 0, 0] * arms_2d[:, 1, 1] - arms_2d[:, 0, 1] * arms_2d[:, 1, 0] < 0
    arms_2d[left], length[left] = arms_2d[left][:, ::-1], length[left][:, ::-1]
    n = len(ends)
    junctions = Junctions(ends[:, 0], arms_2d, length, np.full(n, 1.5), np.full(n, 0.1), np.full((n, 2), 0.01))
    return Structure(edge_field(edges, inverse_depth, SIZE), 0.05 * inverse_depth, junctions)


@pytest.fixture
def scene(rng: np.random.Generator) -> tuple[FloatArray, list[Structure]]:
    world = corners(rng)
    T = np.stack([se3.exp(np.array([-0.15 * i, 0.02 * i, 0.3 * i, 0.0, 0.01 * i, 0.02 * i])) for i in range(4)])
    return T, [see(t, world) for t in T]


def test_nearest_poses_are_by_baseline():
    T = np.stack([se3.exp(np.array([x, 0, 0, 0, 0, 0])) for x in (0.0, 1.0, 1.5, 5.0)])
    np.testing.assert_array_equal(nearest_poses(T, 2), [[1, 2], [2, 0], [1, 0], [2, 1]])
    assert nearest_poses(T, 9).shape == (4, 3)
    assert nearest_poses(T[:1], 3).shape == (1, 0)


def test_terms_fit_at_the_true_poses(scene):
    T, structures = scene
    placed, junctions = edge_terms(structures, T, K), junction_terms(structures, T, K)
    assert placed is not None
    edges = placed.terms
    own = np.stack([structures[h].field.edges.uv[i] for h, i in zip(edges.host, placed.index, strict=True)])
    np.testing.assert_array_equal(own, edges.uv)
    assert junctions is not None
    assert len(edges.pair_edge) > 1000
    assert len(junctions.pair_junction) > 60
    p = WindowProblem(T, np.ones(4, bool), np.zeros((0, 3)), *4 * [np.zeros(0)], K, edges=edges, junctions=junctions)
    result = refine_window(p, LmConfig(max_iterations=0))
    # rows of a corner within 1 px and of an arm within 1 / 20 rad cost less than one each
    assert result.cost_after < 0.7 * (len(edges.pair_edge) + 4 * len(junctions.pair_junction))


def test_limits_of_terms_apply(scene):
    T, structures = scene
    placed = edge_terms(structures, T, K, TermConfig(edges_per_pose=100, targets=1))
    assert placed is not None
    edges = placed.terms
    assert np.bincount(edges.host).max() <= 100
    assert np.bincount(edges.pair_edge).max() == 1


def test_a_corner_with_other_arm_directions_is_not_matched(scene):
    """At the right pixels, but turned by 60 degrees: what one view sees there the others do not."""
    T, structures = scene
    true = junction_terms(structures, T, K)
    c, s = np.cos(np.pi / 3), np.sin(np.pi / 3)
    junctions = structures[2].junctions
    turned = replace(junctions, arms=junctions.arms @ np.array([[c, s], [-s, c]]))
    terms = junction_terms([*structures[:2], replace(structures[2], junctions=turned), structures[3]], T, K)
    pairs = [np.sum((t.pair_pose == 2) & (t.host[t.pair_junction] != 2)) for t in (true, terms)]
    assert pairs[0] > 20
    assert pairs[1] < 0.1 * pairs[0]


def test_no_pairs_give_none(scene):
    T, structures = scene
    bare = Structure(structures[0].field, structures[0].sigma)
    far = np.stack([np.eye(4), se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))])
    assert junction_terms([bare, bare], far, K) is None
    assert edge_terms(structures[:2], far, K) is None
    assert edge_terms(structures[:1], T[:1], K) is None
    assert junction_terms(structures[:1], T[:1], K) is None


def test_structure_of_an_image_points_its_normals_to_the_bright_side():
    grey = np.full((120, 160), 40, np.uint8)
    grey[30:90, 40:120] = 200
    mask = cv2.Canny(cv2.GaussianBlur(grey, (5, 5), 1.0), 30, 80) > 0
    v, u = np.nonzero(mask)
    uv = np.stack([u, v], 1)
    structure = make_structure(grey, uv, np.full(len(u), 0.5), np.full(len(u), 0.01), mask)
    left = (np.abs(u - 40) <= 1) & (v > 40) & (v < 80)
    np.testing.assert_allclose(
        structure.field.edges.normal[left], np.broadcast_to([1.0, 0.0], (left.sum(), 2)), atol=0.05
    )
    assert structure.junctions is not None
    assert len(structure.junctions) == 4
    assert make_structure(grey, np.zeros((0, 2)), np.zeros(0), np.zeros(0)).junctions is None


def test_collinearity_prior_fits_lines_to_inverse_depths(rng):
    truth = np.array([[0.4, 0.3, 0.5]])
    s = rng.uniform(0.05, 1, (1, 2, 9))
    depth = truth[:, :1, None] * (1 - s) + truth[:, 1:, None] * s
    s[0, 1, 4:] = np.nan
    mean, information = collinearity_prior(s, depth, np.full(s.shape, 0.01))
    np.testing.assert_allclose(mean, truth, atol=1e-4)
    assert (np.linalg.eigvalsh(information) > 1e3).all()
    nothing, weak = collinearity_prior(np.full((1, 2, 3), np.nan), np.ones((1, 2, 3)), np.ones((1, 2, 3)))
    assert np.isfinite(nothing).all()
    assert (np.linalg.eigvalsh(weak) > 0).all()
