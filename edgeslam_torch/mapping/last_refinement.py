"""Refinement of the whole map after the last keyframe: anchors first, then with edges and corners."""

import logging
from dataclasses import replace

import numpy as np

from edgeslam_torch.config import WindowConfig
from edgeslam_torch.frontend.canny import canny
from edgeslam_torch.fusion.displacement import TelemetryModel
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.losses.cycle import CycleForm
from edgeslam_torch.losses.robust import Kernel
from edgeslam_torch.losses.weighting import AdaptiveScales
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.edge_map import EdgeMap, EdgePoints
from edgeslam_torch.mapping.fuse import fuse_all
from edgeslam_torch.mapping.motion_terms import solver
from edgeslam_torch.mapping.refinement import refine_all, whole_map, window_problem, write_back
from edgeslam_torch.mapping.reobserve import MAX_DRIFT_PX, reobserve_all
from edgeslam_torch.mapping.window_terms import (
    PlacedEdges,
    Structure,
    TermConfig,
    edge_terms,
    junction_terms,
    make_structure,
)
from edgeslam_torch.optim.adaptive import term_residuals, with_scales
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.problem import LmConfig, StopReason, WindowProblem, WindowResult
from edgeslam_torch.types import FloatArray

logger = logging.getLogger(__name__)

ALIKE = 2.4
"""Errors of neighbours on one edge are correlated: about six count as one (the root of six)."""
ITERATIONS = 30
ROUGH = 1e-2
"""Relative decrease of the cost at which a refinement stops that another one follows: by quadratic convergence the
next step would lower the cost by a few 1e-5, less than one residual changes by one standard deviation."""
FINE = 3e-4
"""The same for the last refinement."""


def lm_config(config: WindowConfig) -> LmConfig:
    """Solver settings of windows while flying."""
    return LmConfig(
        diagnostics=False,
        max_iterations=0 if config.reprojection == "off" else 6,
        cost_tolerance=ROUGH,
        kernel=Kernel.L2 if config.reprojection == "literal" else Kernel.HUBER,
    )


def last_refinement(
    slam_map: SlamMap, camera: Camera, edges: EdgeMap, config: WindowConfig, telemetry: TelemetryModel | None = None
) -> WindowResult | None:
    """Refine all keyframes and anchors, merge duplicates, measure the remaining edges, refine with edges.

    Args:
        slam_map: Refined in place.
        camera: Of its keyframes.
        edges: Their edges, in place as well.
        config: Which terms take part.
        telemetry: Its displacements, heights and gravity take part; None for none.

    Returns:
        Result of the last solver run; None if there was nothing to refine.
    """
    lm = replace(lm_config(config), max_iterations=ITERATIONS)
    fine = replace(lm, cost_tolerance=FINE, losses=True)
    with_edges = config.uses_edges or config.uses_corners
    result = None
    if config.reprojection != "off" and refine_all(slam_map, camera, lm, telemetry) is not None:
        with slam_map.lock:
            drift_px = max(reobserve_all(slam_map, camera), default=0.0)
        if drift_px > MAX_DRIFT_PX:
            refine_all(slam_map, camera, lm, telemetry)
        with slam_map.lock:
            fuse_all(slam_map, camera)
        result = refine_all(slam_map, camera, lm if with_edges else fine, telemetry)
    edges.update(everything=True)
    if with_edges:
        result = refine_with_edges(slam_map, camera, edges, fine, config, telemetry) or result
    return result


def refine_with_edges(
    slam_map: SlamMap,
    camera: Camera,
    edges: EdgeMap,
    lm: LmConfig,
    config: WindowConfig,
    telemetry: TelemetryModel | None = None,
) -> WindowResult | None:
    """Refine the whole map with edge and corner terms beside its anchors; edges are associated again in every round.

    Returns:
        Result of the last round; None if there was nothing to refine.
    """
    window = whole_map(slam_map)
    if window is None:
        return None
    keyframes = [*window.free, *window.fixed]
    hosts = {h.keyframe_id: h for h in edges.hosts}
    terms = term_config(config)
    scales = AdaptiveScales()
    result = None
    for _ in range(config.rounds):
        problem, keypoint = window_problem(slam_map, window, camera, lm, telemetry)
        structures = [_structure(k, hosts.get(k.id), camera, config, edges) for k in keyframes]
        T_c_w = problem.T_c_w[: len(keyframes)]
        placed = edge_terms(structures, T_c_w, problem.K, terms) if config.uses_edges else None
        corners = junction_terms(structures, T_c_w, problem.K, terms) if config.uses_corners else None
        problem = replace(problem, edges=None if placed is None else placed.terms, junctions=corners)
        if config.reprojection == "off":
            problem = _without_points(problem)
        if problem.edges is None and problem.junctions is None:
            return result
        if config.adaptive:
            scales = scales.updated(term_residuals(problem))
            problem = with_scales(problem, scales, ALIKE)
            logger.debug("term scales %s", {k: round(t.sigma, 4) for k, t in scales.terms.items()})
        result = refine_window(problem, solver(lm, problem))
        if result.stop is StopReason.NOT_FINITE:
            return result
        if config.reprojection == "off":
            keypoint = [k[:0] for k in keypoint]
        with slam_map.lock:  # a consistent snapshot for readers
            write_back(slam_map, window, keypoint, result)
            if placed is not None:
                _write_back_depths(keyframes, hosts, camera, placed, result.edge_inverse_depth)
        logger.debug("edges and corners: %s after %d steps", result.stop, result.iterations)
    return result


def term_config(config: WindowConfig) -> TermConfig:
    """Terms of a window for the given settings."""
    default = TermConfig()
    cycle_sigma = {"relative": default.cycle_sigma, "literal": 1.0, "off": 0.0}[config.cycle]
    return TermConfig(
        edges_per_pose=config.edges_per_keyframe,
        targets=config.targets,
        edge_sigma_px=default.edge_sigma_px if config.alignment else 0.0,
        cycle=CycleForm.PIXEL if config.cycle == "literal" else CycleForm.RELATIVE_DEPTH,
        cycle_sigma=cycle_sigma,
        collinearity=config.collinearity,
        # The literal angle's residual is identically zero: omitting it is equivalent.
        angle_sigma=default.angle_sigma if config.angle in ("arms", "cosine") else 0.0,
        cosines=config.angle == "cosine",
    )


def _structure(
    keyframe: Keyframe, host: EdgePoints | None, camera: Camera, config: WindowConfig, edges: EdgeMap
) -> Structure:
    """A keyframe's measured edges; empty if they were not measured."""
    if host is None or keyframe.grey is None:
        blank = np.zeros((camera.height, camera.width), np.uint8)
        return make_structure(blank, np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    z = host.p_c[:, 2]
    mask = canny(keyframe.grey, edges.config.canny_low, edges.config.canny_high) if config.uses_corners else None
    return make_structure(keyframe.grey, host.uv, 1.0 / z, host.sigma / z**2, mask)


def _without_points(problem: WindowProblem) -> WindowProblem:
    none = np.zeros(0, dtype=np.int64)
    return replace(
        problem, obs_pose=none, obs_anchor=none, uv=np.zeros((0, 2)), inv_sigma=np.zeros(0), depth_priors=None
    )


def _write_back_depths(
    keyframes: list[Keyframe],
    hosts: dict[int, EdgePoints],
    camera: Camera,
    placed: PlacedEdges,
    inverse_depth: FloatArray,
) -> None:
    """Write refined depths back to the keyframes' edge points."""
    good = np.isfinite(inverse_depth) & (inverse_depth > 0)
    for pose in np.unique(placed.terms.host):
        mine = np.flatnonzero((placed.terms.host == pose) & good)
        host, index = hosts[keyframes[pose].id], placed.index[mine]
        host.p_c[index] = camera.back_project(host.uv[index], 1.0 / inverse_depth[mine])
