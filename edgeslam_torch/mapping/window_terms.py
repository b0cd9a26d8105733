"""Edge and junction terms of a window from its keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.frontend.corners import Junctions, detect_junctions
from edgeslam_torch.geometry import se3
from edgeslam_torch.mapping.edge_association import EdgeField, associate_edges, edge_field, nearest_edges
from edgeslam_torch.optim.problem import EdgeTerms, JunctionTerms
from edgeslam_torch.types import Edges, FloatArray, IntArray

ARM_REACH_PX = 4.5
"""Distance in position and direction within which an edge lies on an arm: 2 px and 25 degrees."""

UNKNOWN_SIGMA_LOG = 0.35
"""Relative sigma of a corner's depths without a measurement."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Edges and junctions of one keyframe."""

    field: EdgeField
    """Its edges with inverse depths, indexed."""
    sigma: FloatArray
    """``(E,)`` standard deviations of those inverse depths [1/m]."""
    junctions: Junctions | None = None


@dataclass(frozen=True, slots=True)
class TermConfig:
    """Number and weights of the terms."""

    edges_per_pose: int = 800
    hosts: int | None = None
    """Number of first poses whose edges are used; None for all."""
    targets: int = 3
    """Number of target poses per host: those with the smallest baseline."""
    max_px: float = 4.0
    """Maximum distance between a projected edge pixel and its partner."""
    edge_sigma_px: float = 2.0
    """Edges scatter by some 0.8 px, but errors of neighbours are correlated: six count as one. Zero disables
    alignment."""
    least_sigma: float = 0.003
    """Minimum relative depth sigma of an edge."""
    cycle_px: bool = False
    """The cycle in pixels instead of by relative depth."""
    cycle_sigma: float = 0.02
    """Standard deviation of the cycle residual; zero disables the cycle."""
    junction_px: float = 6.0
    """Maximum distance between a projected corner and its partner."""
    junction_turn_rad: float = 0.35
    """Maximum angle between projected and observed arms."""
    arm_points: int = 8
    """Edge points along each arm whose depths are used."""
    arm_px: float = 40.0
    """Maximum used length of an arm."""
    collinearity: str = "relative"
    """Straight arms: whitened by the depths' sigmas, ``literal`` (metres with a sigma of one) or ``off``."""
    angle_sigma: float = 0.05
    """Standard deviation of an angle row; zero disables the angle."""
    cosines: bool = False
    """The cosine of the angle (paper eq. 24 across views) instead of both arms' directions."""


@dataclass(frozen=True, slots=True)
class PlacedEdges:
    """Edge terms with the indices of their edges in the keyframes' lists."""

    terms: EdgeTerms
    index: IntArray
    """``(E,)`` edge of the host's `Structure`."""


def make_structure(
    grey: NDArray[np.uint8],
    uv: FloatArray,
    inverse_depth: FloatArray,
    sigma: FloatArray,
    mask: NDArray[np.bool_] | None = None,
) -> Structure:
    """Index a keyframe's edges of known depth for its neighbours.

    Args:
        grey: Undistorted image ``(H, W)``.
        uv: ``(E, 2)`` edge pixels whose depth is known, at whole pixels.
        inverse_depth: ``(E,)`` [1/m].
        sigma: ``(E,)`` standard deviations [1/m].
        mask: ``(H, W)`` Canny edges, for L-junctions; without it none are detected.
    """
    height, width = grey.shape
    smooth = cv2.GaussianBlur(grey, (5, 5), 1.0)
    u, v = np.clip(np.rint(uv).astype(int), 0, np.array((width - 1, height - 1))).reshape(-1, 2).T
    gradient = [cv2.Sobel(smooth, cv2.CV_32F, *order)[v, u] for order in ((1, 0), (0, 1))]
    normal = _unit(np.stack(gradient, 1)).astype(np.float32)
    edges = Edges(np.asarray(uv, dtype=np.float32).reshape(-1, 2), normal, np.repeat(grey[v, u][:, None], 3, 1))
    junctions = None if mask is None else detect_junctions(grey, mask)
    return Structure(edge_field(edges, inverse_depth, (width, height)), np.asarray(sigma), junctions)


def nearest_poses(T_c_w: FloatArray, count: int) -> IntArray:
    """For each pose the ``count`` others with the nearest camera centres, ``(W, count)``."""
    c = se3.inverse(np.asarray(T_c_w, dtype=np.float64))[:, :3, 3]
    distance = np.linalg.norm(c[:, None] - c[None], axis=2)
    np.fill_diagonal(distance, np.inf)
    return np.argsort(distance, axis=1, kind="stable")[:, : min(count, len(c) - 1)]


def edge_terms(
    structures: Sequence[Structure],
    T_c_w: FloatArray,
    K: tuple[float, float, float, float],
    config: TermConfig | None = None,
) -> PlacedEdges | None:
    """Edge alignment and cycle between each pose and its nearest neighbours; None when no edge finds a partner.

    Args:
        structures: One per pose.
        T_c_w: World-to-camera poses ``(W, 4, 4)``; the association depends on them, so create the terms again after
            poses moved by more than a pixel or two.
        K: fx, fy, cx, cy [px].
        config: Numbers and weights.
    """
    config = config or TermConfig()
    chosen = [
        _spread(s.field.inverse_depth > 0, config.edges_per_pose if config.hosts is None or i < config.hosts else 0)
        for i, s in enumerate(structures)
    ]
    host = np.repeat(np.arange(len(structures)), [len(c) for c in chosen])
    if len(host) == 0 or len(structures) < 2:
        return None
    parts = list(zip(structures, chosen, strict=True))
    uv = np.concatenate([s.field.edges.uv[c] for s, c in parts]).astype(np.float64)
    normal = np.concatenate([s.field.edges.normal[c] for s, c in parts]).astype(np.float64)
    inverse_depth = np.concatenate([s.field.inverse_depth[c] for s, c in parts]).astype(np.float64)
    sigma = np.concatenate([s.sigma[c] for s, c in parts]).astype(np.float64)
    targets = nearest_poses(T_c_w, config.targets)
    edge = np.repeat(np.arange(len(host)), targets.shape[1])
    fields = [s.field for s in structures]
    pairs = associate_edges(
        fields, T_c_w, host, uv, normal, inverse_depth, edge, targets[host].ravel(), K, max_px=config.max_px
    )
    used, pair_edge = np.unique(pairs.pair_edge, return_inverse=True)
    if len(used) == 0:
        return None
    alignment = 1.0 / config.edge_sigma_px if config.edge_sigma_px > 0 else 0.0
    terms = EdgeTerms(
        host=host[used],
        uv=uv[used],
        inverse_depth=inverse_depth[used],
        prior=inverse_depth[used],
        prior_sigma=np.maximum(sigma, config.least_sigma * inverse_depth)[used],
        pair_edge=pair_edge,
        pair_pose=pairs.pair_pose,
        pair_uv=pairs.pair_uv,
        pair_normal=pairs.pair_normal,
        pair_inv_sigma=np.full(len(pair_edge), alignment),
        pair_inverse_depth=pairs.pair_inverse_depth,
        cycle_px=config.cycle_px,
        cycle_sigma=config.cycle_sigma,
    )
    return PlacedEdges(terms, np.concatenate(chosen)[used])


def junction_terms(
    structures: Sequence[Structure],
    T_c_w: FloatArray,
    K: tuple[float, float, float, float],
    config: TermConfig | None = None,
) -> JunctionTerms | None:
    """Junctions observed from neighbouring poses; None without any. Arguments as `edge_terms`."""
    config = config or TermConfig()
    targets = nearest_poses(T_c_w, config.targets) if len(structures) > 1 else np.zeros((len(structures), 0), int)
    rows = []
    ends, priors, informations, hosts = [], [], [], []
    at = 0
    for i, structure in enumerate(structures):
        junctions = structure.junctions
        if junctions is None or len(junctions) == 0:
            continue
        prior, information, known = _junction_depths(structure, config)
        uv = np.concatenate([junctions.uv[:, None], junctions.arm_points(1, config.arm_px)[0][:, :, 0]], 1)
        for j in targets[i]:
            other = structures[j].junctions
            if other is None or len(other) == 0:
                continue
            mine, theirs = _match(uv, prior, known, other, T_c_w[j] @ se3.inverse(T_c_w[i]), K, config)
            arms = _ordered(uv[mine], prior[mine], other.arms[theirs], T_c_w[j] @ se3.inverse(T_c_w[i]), K)
            rows.append((at + mine, np.full(len(mine), j), other.uv[theirs], arms))
        hosts.append(np.full(len(uv), i))
        ends.append(uv)
        priors.append(prior)
        informations.append(information)
        at += len(uv)
    if not rows or sum(len(r[0]) for r in rows) == 0:
        return None
    pair, pose, seen, arms = (np.concatenate(column) for column in zip(*rows, strict=True))
    used, pair = np.unique(pair, return_inverse=True)
    prior = np.concatenate(priors)[used]
    return JunctionTerms(
        host=np.concatenate(hosts)[used],
        uv=np.concatenate(ends)[used],
        inverse_depth=prior,
        prior=prior,
        prior_information=np.concatenate(informations)[used],
        pair_junction=pair,
        pair_pose=pose,
        pair_uv=seen,
        pair_arms=arms,
        inv_sigma_angle=1.0 / config.angle_sigma if config.angle_sigma > 0 else 0.0,
        cosines=config.cosines,
    )


def _spread(mask: np.ndarray, most: int) -> IntArray:
    """At most ``most`` indices at which ``mask`` is true, evenly spread."""
    places = np.flatnonzero(mask)
    if most == 0:
        return places[:0]
    if len(places) <= most:
        return places
    return places[np.linspace(0, len(places) - 1, most).astype(np.int64)]


def _junction_depths(structure: Structure, config: TermConfig) -> tuple[FloatArray, FloatArray, np.ndarray]:
    """Inverse depths of corner and arm ends from the edges on the arms, their information, and which are known."""
    junctions, field = structure.junctions, structure.field
    assert junctions is not None
    uv, fraction = junctions.arm_points(config.arm_points, config.arm_px)
    if len(field.edges.uv) == 0:
        nothing = np.zeros(uv.shape[:-1])
        return *collinearity_prior(np.full_like(nothing, np.nan), nothing, nothing), np.zeros(len(uv), bool)
    across = np.stack([-junctions.arms[..., 1], junctions.arms[..., 0]], -1)[:, :, None] * np.ones(uv.shape[2:])
    # The bright side of an arm is unknown: search both.
    sides = [
        nearest_edges(field, uv.reshape(-1, 2), sign * across.reshape(-1, 2), ARM_REACH_PX) for sign in (1.0, -1.0)
    ]
    partner = np.stack(sides).reshape(2, *uv.shape[:-1])  # (2, C, 2, M)
    away = np.where(partner < 0, np.inf, np.linalg.norm(field.edges.uv[partner] - uv, axis=-1))
    best = away.argmin(0)[None]
    partner = np.take_along_axis(partner, best, 0)[0]
    near = np.take_along_axis(away, best, 0)[0] <= 2.0
    depth, sigma = field.inverse_depth[partner].astype(np.float64), structure.sigma[partner].astype(np.float64)
    given = near & (depth > 0)
    if config.collinearity == "literal":  # equal sigma in metres off the line: d(1 / z) = dz / z^2
        sigma = depth * depth
    sigma = np.where(given, sigma, 1.0)
    prior, information = collinearity_prior(np.where(given, fraction, np.nan), depth, sigma)
    if config.collinearity == "off":  # a weak prior
        information = np.eye(3) / (UNKNOWN_SIGMA_LOG * np.maximum(prior, 1e-6)[:, :, None]) ** 2
    known = (given.sum(2) >= 3).all(1) & (prior > 0).all(1)
    return prior, information, known


def collinearity_prior(
    fraction: FloatArray, inverse_depth: FloatArray, sigma: FloatArray, weak_sigma: float = 10.0
) -> tuple[FloatArray, FloatArray]:
    """Straight arms through the depths of their edge points: prior of a `JunctionTerms`, paper eq. (26).

    A straight line in space has inverse depths that are linear along its image, so the arm is a line fitted to the
    inverse depths of its points; their scatter about it is the collinearity residual.

    Args:
        fraction: Position of each point along its arm ``(C, 2, M)``, 0 at the corner and 1 at the arm's end; NaN
            without a point.
        inverse_depth: Their inverse depths ``(C, 2, M)`` [1/m].
        sigma: Their standard deviations ``(C, 2, M)`` [1/m].
        weak_sigma: Weak prior for junctions without points [1/m].

    Returns:
        Expected inverse depths of corner and arm ends ``(C, 3)`` and their information ``(C, 3, 3)``.
    """
    s = np.asarray(fraction, dtype=np.float64)
    given = np.isfinite(s) & np.isfinite(inverse_depth) & (np.asarray(sigma) > 0)
    s = np.where(given, s, 0.0)
    w = np.where(given, 1.0 / np.where(given, sigma, 1.0), 0.0)
    z = np.where(given, inverse_depth, 0.0)
    A = np.zeros((*s.shape, 3))
    A[..., 0] = 1.0 - s
    A[:, 0, :, 1], A[:, 1, :, 2] = s[:, 0], s[:, 1]
    A = (A * w[..., None]).reshape(len(s), -1, 3)
    right = (z * w).reshape(len(s), -1)
    mean = z.sum((1, 2)) / np.maximum(given.sum((1, 2)), 1)
    weak = 1.0 / weak_sigma**2
    information = np.einsum("cki,ckj->cij", A, A) + weak * np.eye(3)
    moment = np.einsum("cki,ck->ci", A, right) + weak * mean[:, None]
    return np.linalg.solve(information, moment[..., None])[..., 0], information


def _match(
    uv: FloatArray,
    inverse_depth: FloatArray,
    known: np.ndarray,
    other: Junctions,
    T_j_i: FloatArray,
    K: tuple[float, float, float, float],
    config: TermConfig,
) -> tuple[IntArray, IntArray]:
    """Junctions with a partner in the other view, and the partners: near, with similar arms, mutually best."""
    projected, front = _project(T_j_i, uv, inverse_depth, K)
    distance = np.linalg.norm(projected[:, None, 0] - other.uv[None], axis=2)
    arms = _unit(projected[:, 1:] - projected[:, :1])
    straight = np.einsum("iak,jak->ija", arms, other.arms).min(2)
    crossed = np.einsum("iak,jak->ija", arms, other.arms[:, ::-1]).min(2)
    similar = np.maximum(straight, crossed) > np.cos(config.junction_turn_rad)
    distance = np.where(similar & (known & front)[:, None] & (distance < config.junction_px), distance, np.inf)
    best = distance.argmin(1)
    mutual = np.isfinite(distance.min(1)) & (distance.argmin(0)[best] == np.arange(len(uv)))
    return np.flatnonzero(mutual), best[mutual]


def _ordered(
    uv: FloatArray, inverse_depth: FloatArray, arms: FloatArray, T_j_i: FloatArray, K: tuple[float, float, float, float]
) -> FloatArray:
    """Observed arms ``(Q, 2, 2)`` in the order of the host's arms, which reverses if seen from behind."""
    projected, _ = _project(T_j_i, uv, inverse_depth, K)
    mine = _unit(projected[:, 1:] - projected[:, :1])
    swap = (mine * arms).sum(2).min(1) < (mine * arms[:, ::-1]).sum(2).min(1)
    return np.where(swap[:, None, None], arms[:, ::-1], arms)


def _project(
    T: FloatArray, uv: FloatArray, inverse_depth: FloatArray, K: tuple[float, float, float, float]
) -> tuple[FloatArray, np.ndarray]:
    """Pixels ``(C, 3, 2)`` of corner and arm ends in the other view, and which lie in front."""
    rays = np.concatenate([(uv - np.array(K[2:])) / K[:2], np.ones((*uv.shape[:2], 1))], 2)
    q = rays @ T[:3, :3].T + inverse_depth[..., None] * T[:3, 3]
    front: np.ndarray = np.all(q[..., 2] > 1e-6, axis=1)
    z = np.where(q[..., 2] > 1e-6, q[..., 2], 1.0)
    return q[..., :2] / z[..., None] * K[:2] + np.array(K[2:]), front


def _unit(v: FloatArray) -> FloatArray:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-9)
