"""Partners of edge pixels: the right edge, the right way round, and the pose that they give back."""

from dataclasses import replace

import numpy as np
from numeric import edges_along, pixels

from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.edge_association import EdgeField, EdgePairs, associate_edges, edge_field, nearest_edges
from edgeslam_torch.types import Edges, FloatArray

K = (500.0, 500.0, 319.5, 239.5)
SIZE = (640, 480)


def segments(rng: np.random.Generator, count: int = 60) -> tuple[FloatArray, FloatArray]:
    """Points along straight 3-D segments ``(N, 3)`` and the segments' directions ``(N, 3)``."""
    middle = rng.uniform((-1.6, -1.2, 3), (1.6, 1.2, 6), (count, 3))
    direction = rng.normal(size=(count, 3)) * np.array([1, 1, 0.4])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    s = np.linspace(-0.35, 0.35, 120)[None, :, None]
    return (middle[:, None] + s * direction[:, None]).reshape(-1, 3), np.repeat(direction, 120, 0)


def make_edges(uv: FloatArray, normal: FloatArray) -> Edges:
    return Edges(uv.astype(np.float32), normal.astype(np.float32), np.zeros((len(uv), 3), np.uint8))


def see(T: FloatArray, p_w: FloatArray, direction: FloatArray) -> tuple[Edges, FloatArray]:
    """Edge pixels at whole pixels, normals to the left of the segments, and inverse depths."""
    p, farther = se3.transform(T, p_w), se3.transform(T, p_w + 1e-4 * direction)
    edges, which = edges_along(pixels(p, K), pixels(farther, K) - pixels(p, K), SIZE)
    return edges, 1.0 / p[which, 2]


def two_views(rng: np.random.Generator) -> tuple[FloatArray, list[EdgeField]]:
    p_w, direction = segments(rng)
    T = np.stack([np.eye(4), se3.exp(np.array([-0.2, 0.05, 0.1, 0.01, 0.03, 0.15]))])
    return T, [edge_field(*see(t, p_w, direction), SIZE) for t in T]


def pairs_of(
    T: FloatArray, fields: list[EdgeField], inverse_depth: FloatArray | None = None, **gates: float
) -> EdgePairs:
    edges = fields[0].edges
    count = len(edges.uv)
    depth = fields[0].inverse_depth
    everything = np.arange(count)
    host = np.zeros(count, int)
    return associate_edges(fields, T, host, edges.uv, edges.normal, depth, everything, np.ones(count, int), K, **gates)


def distance_px(T: FloatArray, fields: list[EdgeField], pairs: EdgePairs) -> FloatArray:
    """Signed distances ``(P,)`` across the partners' edges."""
    uv, rho = fields[0].edges.uv[pairs.pair_edge], fields[0].inverse_depth[pairs.pair_edge]
    p_i = np.concatenate([(uv - np.array(K[2:])) / K[:2], np.ones((len(uv), 1))], 1) / rho[:, None]
    seen = pixels(se3.transform(T[1] @ se3.inverse(T[0]), p_i), K)
    return ((seen - pairs.pair_uv) * pairs.pair_normal).sum(1)


def test_at_the_true_pose_nearly_all_edges_find_a_partner_within_a_pixel(rng):
    T, fields = two_views(rng)
    pairs = pairs_of(T, fields)
    assert len(pairs.pair_edge) > 0.6 * len(fields[0].edges.uv)  # the rest has left the image or is hidden
    assert np.quantile(np.abs(distance_px(T, fields, pairs)), 0.9) < 1.0
    assert (pairs.pair_pose == 1).all()


def test_edges_of_another_direction_are_no_partners(rng):
    T, fields = two_views(rng)
    edges = fields[1].edges
    flipped = edge_field(replace(edges, normal=-edges.normal), fields[1].inverse_depth, SIZE)
    assert len(pairs_of(T, [fields[0], flipped]).pair_edge) < 0.15 * len(pairs_of(T, fields).pair_edge)


def test_depth_that_disagrees_is_no_partner(rng):
    T, fields = two_views(rng)
    doubled = replace(fields[1], inverse_depth=2.0 * fields[1].inverse_depth)
    assert len(pairs_of(T, [fields[0], doubled]).pair_edge) == 0
    unknown = replace(fields[1], inverse_depth=np.zeros_like(fields[1].inverse_depth))
    assert len(pairs_of(T, [fields[0], unknown]).pair_edge) >= len(pairs_of(T, fields).pair_edge)


def test_the_edge_that_runs_the_same_way_is_found_beside_a_nearer_crossing_one():
    across = np.stack([np.full(41, 100.0), np.arange(80.0, 121.0)], 1)  # upright, normal to the right
    lengthwise = np.stack([np.arange(104.0, 150.0), np.full(46, 100.0)], 1)  # level, normal down
    uv = np.concatenate([across, lengthwise]).astype(np.float32)
    normal = np.repeat(np.array([[1, 0], [0, 1]], np.float32), (41, 46), 0)
    field = edge_field(make_edges(uv, normal), np.zeros(87), SIZE)
    at = np.array([[103.0, 100.0]])  # the level one is nearer
    assert nearest_edges(field, at, np.array([[1.0, 0.0]]), 5.0) == 20
    assert nearest_edges(field, at, np.array([[0.0, 1.0]]), 5.0) == 41
