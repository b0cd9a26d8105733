"""Edge and corner terms of a window's refinement, in flight and at the end."""

from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.config import WindowConfig
from edgeslam_torch.frontend.canny import canny, edge_thresholds
from edgeslam_torch.frontend.edges import extract_edges
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.mapping.edges.edge_map import EdgeMap, EdgePoints
from edgeslam_torch.mapping.window_terms import (
    PlacedEdges,
    Structure,
    TermConfig,
    edge_terms,
    junction_terms,
    make_structure,
)
from edgeslam_torch.optim.adaptive import term_residuals, term_sigmas, with_scales
from edgeslam_torch.optim.problem import WindowProblem
from edgeslam_torch.types import FloatArray

FEW_ANCHORS = 100
"""Number of anchors of a keyframe below which its window gets edge terms: the minimum to start a map."""

EFFECTIVE_SAMPLES = 2.4
"""Errors of neighbouring pixels on an edge are correlated: about six count as one (the root of six)."""


@dataclass(frozen=True, slots=True)
class Placed:
    """A window with its edge and corner terms."""

    problem: WindowProblem
    edges: PlacedEdges | None

    @property
    def has_terms(self) -> bool:
        """Whether any edge or corner found a partner."""
        return self.problem.edges is not None or self.problem.junctions is not None


class WindowEdges:
    """Creates the terms of windows; caches the last window's indexed edges.

    Args:
        edges: Measured edges by keyframe.
        camera: Intrinsics of the keyframes.
        config: Terms and their form.
        flying: Keyframes whose edges are not measured yet take part as targets.
    """

    def __init__(self, edges: EdgeMap, camera: Camera, config: WindowConfig, flying: bool) -> None:
        self.edges = edges
        self.camera = camera
        self.config = config
        self.flying = flying
        self.terms = term_config(config)
        self._indexed: dict[int, _Indexed] = {}
        """Indexed edges of the last window, by keyframe id."""

    def wanted(self, newest: Keyframe) -> bool:
        """Whether the window of a new keyframe gets edge terms in flight."""
        if self.config.in_flight == "few":
            return newest.features.faint or int(np.count_nonzero(newest.anchor >= 0)) < FEW_ANCHORS
        return self.config.in_flight == "always"

    def place(self, problem: WindowProblem, keyframes: list[Keyframe]) -> Placed:
        """Add the terms to a window whose first poses are those of the keyframes, the free ones first.

        While flying, the free keyframes' edges are used, and the others as partners. After the flight the terms are
        weighted by their residuals (``adaptive``), and without ``reprojection`` there are no others.
        """
        free = int(np.count_nonzero(~problem.pose_fixed))
        terms = replace(self.terms, hosts=free) if self.flying else self.terms
        structures = self._structures(keyframes)
        T_c_w, K = problem.T_c_w[: len(keyframes)], problem.K
        placed = edge_terms(structures, T_c_w, K, terms) if self.config.uses_edges else None
        corners = junction_terms(structures, T_c_w, K, terms) if self.config.uses_corners else None
        problem = replace(problem, edges=None if placed is None else placed.terms, junctions=corners)
        if self.config.reprojection == "off" and not self.flying:
            problem = _without_points(problem)
        out = Placed(problem, placed)
        if self.config.adaptive and not self.flying and (out.has_terms or len(problem.obs_pose)):
            out = Placed(with_scales(problem, term_sigmas(term_residuals(problem)), EFFECTIVE_SAMPLES), placed)
        return out

    def write_back(self, keyframes: list[Keyframe], placed: PlacedEdges | None, inverse_depth: FloatArray) -> None:
        """Write refined depths back to the keyframes' edge points."""
        if placed is None:
            return
        hosts = {h.keyframe_id: h for h in self.edges.hosts}
        good = np.isfinite(inverse_depth) & (inverse_depth > 0)
        for pose in np.unique(placed.terms.host):
            mine = np.flatnonzero((placed.terms.host == pose) & good)
            host, index = hosts[keyframes[pose].id], placed.index[mine]
            host.p_c[index] = self.camera.back_project(host.uv[index], 1.0 / inverse_depth[mine])

    def _structures(self, keyframes: list[Keyframe]) -> list[Structure]:
        """The keyframes' edges; of a keyframe in the last window, only depths are updated."""
        hosts = {h.keyframe_id: h for h in self.edges.hosts}
        self._indexed = {k.id: self._index(k, hosts.get(k.id)) for k in keyframes}
        return [self._indexed[k.id].now(hosts.get(k.id)) for k in keyframes]

    def _index(self, keyframe: Keyframe, host: EdgePoints | None) -> "_Indexed":
        uv = None if host is None else host.uv
        known = self._indexed.get(keyframe.id)
        if known is not None and known.uv is uv:
            return known
        config, grey = self.edges.config, keyframe.grey
        pixels: FloatArray
        if grey is None or (uv is None and not self.flying):
            grey, pixels = np.zeros((self.camera.height, self.camera.width), np.uint8), np.zeros((0, 2))
        elif uv is None:
            pixels = extract_edges(grey, config.canny_low, config.canny_high, config.max_pixels).uv
        else:
            pixels = uv
        corners = self.config.uses_corners and uv is not None
        mask = canny(grey, *edge_thresholds(grey, config.canny_low, config.canny_high)) if corners else None
        unknown = np.zeros(len(pixels))
        return _Indexed(uv, make_structure(grey, pixels, unknown, unknown, mask))


@dataclass(frozen=True, slots=True)
class _Indexed:
    """A keyframe's indexed edges."""

    uv: FloatArray | None
    """The measured edges that they were made of; None for unmeasured ones."""
    structure: Structure

    def now(self, host: EdgePoints | None) -> Structure:
        """With current depths."""
        if host is None or len(self.structure.field.edges.uv) != len(host.uv):
            return self.structure
        z = host.p_c[:, 2]
        field = replace(self.structure.field, inverse_depth=1.0 / z)
        return replace(self.structure, field=field, sigma=host.sigma / z**2)


def term_config(config: WindowConfig) -> TermConfig:
    """Terms of a window for the given settings."""
    default = TermConfig()
    cycle_sigma = {"relative": default.cycle_sigma, "literal": 1.0, "off": 0.0}[config.cycle]
    return TermConfig(
        edges_per_pose=config.edges_per_keyframe,
        targets=config.targets,
        edge_sigma_px=default.edge_sigma_px if config.alignment else 0.0,
        cycle_px=config.cycle == "literal",
        cycle_sigma=cycle_sigma,
        collinearity=config.collinearity,
        # The literal angle's residual is identically zero: omitting it is equivalent.
        angle_sigma=default.angle_sigma if config.angle in ("arms", "cosine") else 0.0,
        cosines=config.angle == "cosine",
    )


def _without_points(problem: WindowProblem) -> WindowProblem:
    none = np.zeros(0, dtype=np.int64)
    return replace(
        problem, obs_pose=none, obs_anchor=none, uv=np.zeros((0, 2)), inv_sigma=np.zeros(0), depth_priors=None
    )
