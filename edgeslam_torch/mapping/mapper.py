"""Stages 3 and 4 for one keyframe: cull, triangulate, fuse, refine, cull keyframes."""

from dataclasses import replace

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.frontend.keypoint_grid import KeypointGrid
from edgeslam_torch.frontend.matching import Matches
from edgeslam_torch.frontend.orb import spread
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.robust_statistics import CHI2_2DOF_95
from edgeslam_torch.map.depth_prior import depth_prior
from edgeslam_torch.map.growth import depths, take_along
from edgeslam_torch.map.keyframe import NO_ANCHOR, Keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.sub_pixel import align
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.mapping.fuse import fuse_new
from edgeslam_torch.mapping.local_loop_closure import MAX_DRIFT_PX, reobserve
from edgeslam_torch.mapping.new_anchors import epipolar_matches, triangulate_matches
from edgeslam_torch.mapping.prior_anchors import (
    add_on_prior,
    drop_redundant_priors,
    inverse_depth_with_prior,
    prior_of,
    rays,
)
from edgeslam_torch.mapping.refinement import choose_window, new_map, recent_map, refine, refine_all
from edgeslam_torch.mapping.window_edges import WindowEdges
from edgeslam_torch.optim.problem import LmConfig, WindowResult
from edgeslam_torch.types import FloatArray, IntArray

MIN_PARALLAX_DEG = 1.0
"""Minimum parallax of a triangulated anchor."""
REDUNDANCY = 0.95
"""A keyframe is redundant when this share of its anchors is observed by three others; of 300 anchors, 15 remain, the
threshold of covisibility."""
WIDE = 60
"""Keyframes of a wide window: some 20 s of flight. With 25, the two fixed poses dominate the scale and its correction
overshoots."""
WIDE_EVERY_S = 1.0
"""Minimum time between wide windows."""
WIDE_STEPS = 100
"""Maximum number of solver steps: 15 are typical, the first run after a long drift takes several times that."""
ENOUGH_ANCHORS = 300
"""Number of anchors below which empty regions of a keyframe are filled from the depth prior alone."""
EMPTY_RADIUS_PX = 25.0
"""Minimum distance of a keypoint in an empty region from the next anchor."""

ONLY_VIEW = 0.5
"""Share of a keyframe's anchors that culling it would remove, above which it is the only view of its place."""


class Mapper:
    """Inserts keyframes into the map, one at a time.

    Args:
        slam_map: The map.
        camera: Intrinsics of its keyframes.
        config: All settings.
        lm: Settings of the solver.
        edges: Measured edges for the refinement; None for none.
    """

    def __init__(
        self, slam_map: SlamMap, camera: Camera, config: SlamConfig, lm: LmConfig, edges: EdgeMap | None = None
    ) -> None:
        self.map = slam_map
        self.camera = camera
        self.orb = config.orb
        self.config = config.mapping
        self.lm = lm
        flying = config.window.flying
        self._edges = None if edges is None or flying is None else WindowEdges(edges, camera, flying, flying=True)
        self._wide_s = -np.inf
        """Stamp of the last wide window."""
        self._recent: IntArray = np.zeros(0, dtype=np.int64)

    def insert(
        self, keyframe: Keyframe, colour: np.ndarray, telemetry: TelemetryModel | None = None
    ) -> WindowResult | None:
        """Insert a new keyframe: cull, triangulate, fuse, close local loops, refine.

        Args:
            keyframe: Already in the map; ``keyframe.anchor`` has the matches of tracking.
            colour: RGB of each keypoint, ``(N, 3)`` uint8.
            telemetry: For the refinement.

        Returns:
            Result of the window refinement, or None without any.
        """
        with self.map.lock:
            self.map.anchors.begin_pass()
            self.cull_recent_anchors(keyframe)
            neighbours = self.map.covisible(keyframe, self.config.neighbours)
            self.triangulate_new(keyframe, neighbours, colour)
            fuse_new(self.map, self.camera, keyframe, self.map.covisible(keyframe, 2 * self.config.neighbours))
            drift_px = reobserve(self.map, self.camera, keyframe)
            if self.config.sub_pixel:
                align(self.map, keyframe, self.camera)
        if drift_px is not None and drift_px > MAX_DRIFT_PX:  # the drift lies outside the window
            refine_all(self.map, self.camera, self.lm, telemetry)
        edges = self._edges if self._edges is not None and self._edges.wanted(keyframe) else None
        result = self._take_back_drift(keyframe, telemetry)
        if result is None or edges is not None:
            free, fixed = self.config.window, self.config.window_fixed
            window = new_map(self.map, keyframe, free + fixed) or choose_window(self.map, keyframe, free, fixed)
            result = refine(self.map, window, self.camera, self.lm, telemetry, edges)
        with self.map.lock:
            # Refinement moves the other keyframes too little to change viewing directions.
            self.map.refresh_anchors(keyframe.anchor[keyframe.anchor >= 0])
            drop_redundant_priors(self.map, keyframe, np.deg2rad(MIN_PARALLAX_DEG))
            self.cull_keyframes(keyframe)
        return result

    def _take_back_drift(self, keyframe: Keyframe, telemetry: TelemetryModel | None) -> WindowResult | None:
        """Refine the recent map with metric telemetry every second; None without a converged result.

        The fixed keyframes of a small window preserve its scale, drifted or not, against telemetry.
        """
        if telemetry is None or not telemetry.metric or keyframe.stamp_s - self._wide_s < WIDE_EVERY_S:
            return None
        self._wide_s = keyframe.stamp_s
        window = recent_map(self.map, keyframe, WIDE)
        if window is None:
            return None
        keyframes = sorted([*window.fixed, *window.free], key=lambda k: k.id)
        before = depths(self.map, keyframes)
        result = refine(self.map, window, self.camera, replace(self.lm, max_iterations=WIDE_STEPS), telemetry)
        take_along(self.map, keyframes, before)
        return result if result is not None and result.stop.converged else None

    def cull_recent_anchors(self, keyframe: Keyframe) -> None:
        """Remove new anchors that tracking rarely finds or that only two keyframes observe."""
        anchors = self.map.anchors
        recent = self._recent[anchors.alive[self._recent]]
        age = keyframe.id - anchors.born[recent]
        rarely_found = anchors.found[recent] < 0.25 * anchors.visible[recent]
        few_views = (age >= 2) & (anchors.observations[recent] <= 2)
        self.map.remove_anchors(recent[rarely_found | few_views])
        self._recent = recent[~(rarely_found | few_views) & (age < 3)]

    def triangulate_new(self, keyframe: Keyframe, neighbours: list[Keyframe], colour: np.ndarray) -> None:
        """Triangulate keypoints without an anchor in either keyframe."""
        prior, sigma = np.full((2, len(keyframe.anchor)), np.nan)
        free = np.flatnonzero(keyframe.anchor < 0)
        prior[free], sigma[free] = depth_prior(keyframe, keyframe.features.uv[free], self.map.anchors)
        if not np.isfinite(prior).any():
            return
        min_baseline = 0.01 * float(np.nanmedian(prior))
        new = [self._recent[:0]]
        far: list[tuple[Keyframe, Matches]] = []
        for other in neighbours:
            matches = epipolar_matches(
                keyframe,
                other,
                self.camera,
                prior,
                sigma,
                self.orb.scale_factor,
            )
            far.append((other, matches))
            if np.linalg.norm(other.centre_w - keyframe.centre_w) < min_baseline:
                continue
            p_w, sigma_ray, used = triangulate_matches(
                keyframe,
                other,
                matches,
                self.camera,
                self.orb.scale_factor,
                np.deg2rad(MIN_PARALLAX_DEG),
            )
            if len(p_w) == 0:
                continue
            mine, theirs = matches.query[used], matches.train[used]
            ids = self.map.anchors.add(p_w, keyframe.words[mine], keyframe.id, False, colour[mine])
            self.map.anchors.sigma[ids] = sigma_ray
            self.map.observe(keyframe, mine, ids)
            self.map.observe(other, theirs, ids)
            new.append(ids)
        known = prior_of(prior, sigma)
        for other, matches in far:
            if self.missing(keyframe) > 0:
                new.append(self.place_far(keyframe, other, matches, known, colour))
        new.append(self.fill_empty_places(keyframe, known, colour))
        ids = np.concatenate(new)
        self.map.refresh_anchors(ids)
        self._recent = np.concatenate([self._recent, ids])

    def place_far(
        self, keyframe: Keyframe, other: Keyframe, matches: Matches, prior: FloatArray, colour: np.ndarray
    ) -> IntArray:
        """Anchors on matches with too little parallax to be triangulated: their depth is estimated from prior and
        images together.

        Args:
            keyframe: The new one, which becomes their host.
            other: The keyframe that it was matched with.
            matches: Matches of its keypoints; those with an anchor are skipped.
            prior: Expected inverse depth and standard deviation of every keypoint ``(N, 2)`` [1/map unit].
            colour: RGB ``(N, 3)``.

        Returns:
            Their ids.
        """
        free = np.flatnonzero((keyframe.anchor[matches.query] < 0) & (other.anchor[matches.train] < 0))
        mine, theirs = matches.query[free], matches.train[free]
        if len(mine) == 0:
            return mine
        sigma_px = self.orb.scale_factor ** other.features.octave[theirs].astype(np.float64)
        T_o_k = other.T_c_w @ keyframe.T_w_c
        ray, uv = rays(keyframe, mine, self.camera), other.features.uv[theirs].astype(np.float64)
        found, chi2 = inverse_depth_with_prior(ray, uv, sigma_px, T_o_k, self.camera, prior[mine])
        good = chi2 <= CHI2_2DOF_95
        mine, theirs, found = mine[good], theirs[good], found[good]
        ids = add_on_prior(self.map, self.camera, keyframe, mine, found[:, 0], prior[mine], colour[mine])
        self.map.observe(other, theirs, ids)
        return ids

    def missing(self, keyframe: Keyframe) -> int:
        """Number of anchors missing to `ENOUGH_ANCHORS`."""
        return max(0, ENOUGH_ANCHORS - int(np.count_nonzero(keyframe.anchor != NO_ANCHOR)))

    def fill_empty_places(self, keyframe: Keyframe, prior: FloatArray, colour: np.ndarray) -> IntArray:
        """Fill empty regions of a keyframe with anchors on the depth prior alone.

        Args:
            keyframe: The new one, which becomes their host.
            prior: Expected inverse depth and standard deviation of every keypoint ``(N, 2)`` [1/map unit].
            colour: RGB ``(N, 3)``.

        Returns:
            Their ids.
        """
        missing = self.missing(keyframe)
        free = np.flatnonzero((keyframe.anchor == NO_ANCHOR) & np.isfinite(prior).all(1))
        if missing <= 0 or keyframe.depth is None or len(free) == 0:
            return free[:0]
        uv = keyframe.features.uv
        taken = KeypointGrid(uv[keyframe.anchor != NO_ANCHOR])
        occupied, _ = taken.near(uv[free], np.full(len(free), EMPTY_RADIUS_PX))
        free = np.delete(free, np.unique(occupied))
        chosen = free[spread(uv[free], -prior[free, 1], self.camera.width, self.camera.height, missing)]
        return add_on_prior(self.map, self.camera, keyframe, chosen, prior[chosen, 0], prior[chosen], colour[chosen])

    def cull_keyframes(self, newest: Keyframe) -> None:
        """Remove covisible keyframes whose anchors three others see at the same or finer scale; limit the map size."""
        for other in self.map.covisible(newest, 2 * self.config.window):
            if other.id == 0 or newest.id - other.id < 3:
                continue
            observed = other.anchor[other.anchor >= 0]
            if len(observed) == 0 or np.mean(self.map.anchors.observations[observed] >= 4) > REDUNDANCY:
                self.map.remove_keyframe(other)
        while len(self.map.keyframes) > self.config.max_keyframes:
            redundant = self._most_redundant(newest)
            if redundant is None:
                return
            self.map.remove_keyframe(redundant)

    def _most_redundant(self, newest: Keyframe) -> Keyframe | None:
        """The most redundant keyframe outside the window; of equal ones, the oldest.

        None if each is the only view of its place and there are fewer than twice `MappingConfig.max_keyframes`.
        """
        others = [k for k in self.map.keyframes.values() if newest.id - k.id >= self.config.window]
        lost = [self._lost_without(k) for k in others]
        least = int(np.argmin(lost))
        if lost[least] > ONLY_VIEW and len(self.map.keyframes) <= 2 * self.config.max_keyframes:
            return None
        return others[least]

    def _lost_without(self, keyframe: Keyframe) -> float:
        """Share of a keyframe's anchors that at most one other keyframe sees; culling it removes them."""
        observed = keyframe.anchor[keyframe.anchor >= 0]
        return float(np.mean(self.map.anchors.observations[observed] <= 2)) if len(observed) else 0.0
