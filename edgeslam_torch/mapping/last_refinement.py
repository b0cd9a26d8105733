"""Refinement of the whole map after the last keyframe, with edges and corners."""

from dataclasses import replace

from edgeslam_torch.config import WindowConfig
from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.freed_depths import Weight
from edgeslam_torch.mapping.fuse import fuse_all
from edgeslam_torch.mapping.motion_terms import EFFECTIVE_SAMPLES_AT_THE_END
from edgeslam_torch.mapping.refinement import refine, whole_map
from edgeslam_torch.mapping.window_edges import WindowEdges
from edgeslam_torch.optim.problem import LmConfig, WindowResult

ITERATIONS = 30
COST_TOLERANCE = 1e-5
POSE_TOLERANCE = 0.1
"""Distance to the minimum [standard deviations, all poses together]. At half a standard deviation the drift of scale in
big steps, a direction of small curvature, is left in the map."""
NEARLY = 1.0
"""The same where edges are only associated, which takes poses to a pixel."""
MU = 1e-8
"""Initial damping: scale drift, or rotation explained as translation, is a slow mode, which a solver damped by the
stiff modes never corrects (docs/decisions/12-solver.md)."""


def lm_config(config: WindowConfig) -> LmConfig:
    """Solver settings of every refinement of the map."""
    return LmConfig(
        solver=config.solver,
        diagnostics=False,
        max_iterations=0 if config.reprojection == "off" else ITERATIONS,
        mu=MU,
        cost_tolerance=COST_TOLERANCE,
        pose_tolerance=POSE_TOLERANCE,
        robust=config.reprojection != "literal",
    )


def last_refinement(
    slam_map: SlamMap, camera: Camera, edges: EdgeMap, config: WindowConfig, telemetry: TelemetryModel | None = None
) -> WindowResult | None:
    """Merge duplicate anchors, refine poses and anchors, measure the remaining edges, refine everything.

    Edges are associated and weighted at the poses of the first refinement, which also removes outliers.

    Args:
        slam_map: Refined in place.
        camera: Intrinsics of its keyframes.
        edges: Their edges, also refined in place.
        config: Selects the terms.
        telemetry: Adds displacements, heights and gravity; None for none.

    Returns:
        The solver's result; None if there was nothing to refine.
    """
    lm = replace(lm_config(config), max_iterations=ITERATIONS, losses=True)
    freed = Weight.NONE if config.reprojection == "off" else Weight.EXACT
    if config.reprojection != "off":
        with slam_map.lock:
            fuse_all(slam_map, camera)
        if (window := whole_map(slam_map, freed, EFFECTIVE_SAMPLES_AT_THE_END)) is not None:
            refine(slam_map, window, camera, replace(lm, losses=False, pose_tolerance=NEARLY), telemetry)
    edges.update(everything=True)
    with slam_map.lock:
        edges.follow_anchors()
    window = whole_map(slam_map, freed, EFFECTIVE_SAMPLES_AT_THE_END)
    if window is None:
        return None
    return refine(slam_map, window, camera, lm, telemetry, WindowEdges(edges, camera, config, flying=False))
