"""Seeded windows for the solver, and gtsam's solution of them."""

from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.geometry import se3
from edgeslam_torch.optim.blocks import POINT_DELTA
from edgeslam_torch.optim.problem import EdgeTerms, JunctionTerms, WindowProblem
from edgeslam_torch.types import FloatArray, IntArray

K = (525.0, 525.0, 319.5, 239.5)
SIZE = (640, 480)


@dataclass(frozen=True, slots=True)
class WindowSize:
    """Size of a seeded window."""

    poses: int = 10
    fixed: int = 1
    anchors: int = 1500
    observations: int = 6000
    edges: int = 10_000
    pairs: int = 40_000
    junctions: int = 300


@dataclass(frozen=True, slots=True)
class Noise:
    """Standard deviations of a seeded window's measurements and initial state."""

    px: float = 0.7
    depth: float = 0.1
    """Of the log of a network's depth."""
    start_translation: float = 0.02
    start_rotation: float = 0.01
    start_point: float = 0.03


@dataclass(frozen=True, slots=True)
class SeededWindow:
    """A window with its truth."""

    problem: WindowProblem
    T_c_w: FloatArray
    p_w: FloatArray
    edge_inverse_depth: FloatArray


def seeded_window(seed: int = 0, size: WindowSize | None = None, noise: Noise | None = None) -> SeededWindow:
    """A camera moving past a cloud of points, edges and corners, determined by ``seed``."""
    size, noise = size or WindowSize(), noise or Noise()
    rng = np.random.default_rng(seed)
    W = size.poses
    T = np.stack([se3.exp(np.array([-0.6 * i / max(W - 1, 1), 0.0, 0.0, 0.0, 0.0, 0.0])) for i in range(W)])
    T = np.stack([se3.exp(0.03 * rng.normal(size=6)) @ t for t in T])
    p_w = rng.uniform((-2.2, -1.6, 2.5), (2.8, 1.6, 7.0), (size.anchors, 3))
    pose, anchor, uv = _observe(rng, T, p_w, size.observations)
    problem = WindowProblem(
        T_c_w=T.copy(),
        pose_fixed=np.arange(W) < size.fixed,
        p_w=p_w + noise.start_point * rng.normal(size=p_w.shape),
        obs_pose=pose,
        obs_anchor=anchor,
        uv=uv + noise.px * rng.normal(size=uv.shape),
        inv_sigma=np.full(len(uv), 1.0 / noise.px if noise.px > 0 else 1.0),
        K=K,
    )
    for i in np.flatnonzero(~problem.pose_fixed):
        spread = np.repeat([noise.start_translation, noise.start_rotation], 3)
        problem.T_c_w[i] = se3.exp(spread * rng.normal(size=6)) @ T[i]
    edges = _edges(rng, T, size, noise) if size.edges else None
    junctions = _junctions(rng, T, size, noise) if size.junctions else None
    truth = np.zeros(0) if edges is None else edges[1]
    problem = replace(problem, edges=None if edges is None else edges[0], junctions=junctions)
    return SeededWindow(problem, T, p_w, truth)


def _project(T: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pixels ``(N, 2)`` and depths ``(N,)`` of world points through poses ``(N, 4, 4)``."""
    p_c = np.einsum("nij,nj->ni", T[:, :3, :3], p) + T[:, :3, 3]
    return p_c[:, :2] / p_c[:, 2:] * K[:2] + np.array(K[2:]), p_c[:, 2]


def _inside(uv: FloatArray, z: FloatArray) -> np.ndarray:
    return (z > 0.1) & (uv >= 0).all(1) & (uv <= np.array(SIZE) - 1).all(1)


def _observe(
    rng: np.random.Generator, T: FloatArray, p: FloatArray, count: int
) -> tuple[IntArray, IntArray, FloatArray]:
    pose, anchor = np.divmod(rng.permutation(len(T) * len(p)), len(p))
    uv, z = _project(T[pose], p[anchor])
    keep = np.flatnonzero(_inside(uv, z))[:count]
    return pose[keep], anchor[keep], uv[keep]


def _hosted(
    rng: np.random.Generator, T: FloatArray, count: int, margin: float = 20.0
) -> tuple[IntArray, FloatArray, FloatArray]:
    host = np.sort(rng.integers(0, len(T), count))
    return host, rng.uniform((margin, margin), np.array(SIZE) - margin, (count, 2)), 1.0 / rng.uniform(2.5, 7.0, count)


def _lift(T: FloatArray, uv: FloatArray, inverse_depth: FloatArray) -> FloatArray:
    """World points ``(N, 3)`` of pixels in poses ``(N, 4, 4)``."""
    rays = np.concatenate([(uv - np.array(K[2:])) / K[:2], np.ones((len(uv), 1))], 1) / inverse_depth[:, None]
    return np.einsum("nji,nj->ni", T[:, :3, :3], rays - T[:, :3, 3])


def _pairs(rng: np.random.Generator, host: IntArray, W: int, per_block: int) -> tuple[IntArray, IntArray]:
    """Each block with the poses nearest to its host in time."""
    order = np.argsort(np.abs(np.arange(W)[:, None] - np.arange(W)), axis=1, kind="stable")[:, 1 : per_block + 1]
    block = np.repeat(np.arange(len(host)), order.shape[1])
    return block, order[host].ravel()


def _edges(rng: np.random.Generator, T: FloatArray, size: WindowSize, noise: Noise) -> tuple[EdgeTerms, FloatArray]:
    host, uv, inverse_depth = _hosted(rng, T, size.edges)
    p_w = _lift(T[host], uv, inverse_depth)
    block, target = _pairs(rng, host, len(T), min(len(T) - 1, 2 + size.pairs // max(size.edges, 1)))
    uv_j, z = _project(T[target], p_w[block])
    keep = np.flatnonzero(_inside(uv_j, z))
    keep = np.sort(rng.permutation(keep)[: size.pairs])
    block, target, uv_j, z = block[keep], target[keep], uv_j[keep], z[keep]
    angle = rng.uniform(0, 2 * np.pi, len(keep))
    normal = np.stack([np.cos(angle), np.sin(angle)], 1)
    along = np.stack([-normal[:, 1], normal[:, 0]], 1) * rng.uniform(-3, 3, (len(keep), 1))
    across = normal * noise.px * rng.normal(size=(len(keep), 1))
    network = inverse_depth * np.exp(noise.depth * rng.normal(size=size.edges))
    terms = EdgeTerms(
        host=host,
        uv=uv,
        inverse_depth=network,
        prior=network,
        prior_sigma=np.full(size.edges, max(noise.depth, 0.01)) * network,
        pair_edge=block,
        pair_pose=target,
        pair_uv=uv_j + along + across,
        pair_normal=normal,
        pair_inv_sigma=np.full(len(keep), 1.0 / max(noise.px, 0.1)),
        pair_inverse_depth=np.exp(noise.depth * rng.normal(size=len(keep))) / z,
        cycle_sigma=max(0.5 * noise.depth, 0.01),
    )
    return terms, inverse_depth


def _junctions(rng: np.random.Generator, T: FloatArray, size: WindowSize, noise: Noise) -> JunctionTerms:
    C = size.junctions
    host, corner, _ = _hosted(rng, T, C, margin=80.0)
    first = rng.uniform(0, 2 * np.pi, C)
    angles = np.stack([first, first + rng.uniform(0.4 * np.pi, 0.6 * np.pi, C)], 1)
    arms = 30.0 * np.stack([np.cos(angles), np.sin(angles)], 2)
    uv = np.concatenate([corner[:, None], corner[:, None] + arms], 1)  # (C, 3, 2)
    true = (1.0 / rng.uniform(2.5, 7.0, C))[:, None] * (1.0 + 0.05 * rng.normal(size=(C, 3)))
    p_w = _lift(np.repeat(T[host], 3, 0), uv.reshape(-1, 2), true.ravel())
    block, target = _pairs(rng, host, len(T), 4)
    seen, z = _project(np.repeat(T[target], 3, 0), p_w.reshape(-1, 3, 3)[block].reshape(-1, 3))
    seen, front = seen.reshape(-1, 3, 2), (z > 0.1).reshape(-1, 3).all(1)
    block, target, seen = block[front], target[front], seen[front]
    directions = seen[:, 1:] - seen[:, :1]
    turn = 0.02 * rng.normal(size=directions.shape[:2]) * (noise.px > 0)
    directions = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    cos, sin = np.cos(turn), np.sin(turn)
    x, y = directions[..., 0], directions[..., 1]
    network = true * np.exp(noise.depth * rng.normal(size=(C, 1)))
    return JunctionTerms(
        host=host,
        uv=uv,
        inverse_depth=network,
        prior=network,
        prior_information=np.eye(3) / (max(noise.depth, 0.01) * network[:, :, None]) ** 2,
        pair_junction=block,
        pair_pose=target,
        pair_uv=seen[:, 0] + noise.px * rng.normal(size=(len(block), 2)),
        pair_arms=np.stack([cos * x - sin * y, sin * x + cos * y], -1),
        inv_sigma_px=1.0 / max(noise.px, 0.1),
        inv_sigma_angle=50.0,
    )


def points_only(window: SeededWindow) -> SeededWindow:
    """The same window without edges and junctions."""
    return replace(window, problem=replace(window.problem, edges=None, junctions=None))


def refine_with_gtsam(problem: WindowProblem, iterations: int) -> tuple[float, FloatArray]:
    """The window's points-only part through gtsam's Levenberg-Marquardt, as an outside oracle.

    Args:
        problem: A window; its edges, junctions and priors are left out.
        iterations: Steps to take.

    Returns:
        Robust cost as ours counts it, and the refined ``(W, 4, 4)`` world-to-camera poses.

    Raises:
        ModuleNotFoundError: Without gtsam, which is a development tool.
    """
    import gtsam

    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-7)
    fx, fy, cx, cy = problem.K
    calibration = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
    huber = gtsam.noiseModel.mEstimator.Huber.Create(POINT_DELTA)
    noises = {
        s: gtsam.noiseModel.Robust.Create(huber, gtsam.noiseModel.Isotropic.Sigma(2, 1.0 / s))
        for s in np.unique(problem.inv_sigma)
    }
    for i, T in enumerate(se3.inverse(problem.T_c_w)):
        pose = gtsam.Pose3(gtsam.Rot3(T[:3, :3]), T[:3, 3])
        initial.insert(gtsam.symbol("x", i), pose)
        if problem.pose_fixed[i]:  # no hard constraint: with one, gtsam eliminates by QR and takes four times as long
            graph.add(gtsam.PriorFactorPose3(gtsam.symbol("x", i), pose, held))
    for a in np.unique(problem.obs_anchor):
        initial.insert(gtsam.symbol("l", int(a)), problem.p_w[a])
    for i, a, uv, s in zip(problem.obs_pose, problem.obs_anchor, problem.uv, problem.inv_sigma, strict=True):
        x, l = gtsam.symbol("x", int(i)), gtsam.symbol("l", int(a))
        graph.add(gtsam.GenericProjectionFactorCal3_S2(uv, noises[s], x, l, calibration))
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(iterations)
    params.setRelativeErrorTol(0.0)
    params.setAbsoluteErrorTol(0.0)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, initial, params)
    result = optimiser.optimize()
    T_w_c = np.stack([result.atPose3(gtsam.symbol("x", i)).matrix() for i in range(len(problem.T_c_w))])
    return 2.0 * graph.error(result), se3.inverse(T_w_c)
