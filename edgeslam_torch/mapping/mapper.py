"""Stage 3 and 4 for one keyframe: cull, triangulate, fuse, refine, cull keyframes."""

import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.mapping.depth_prior import depth_prior
from edgeslam_torch.mapping.fuse import fuse
from edgeslam_torch.mapping.keyframe import Keyframe
from edgeslam_torch.mapping.new_anchors import epipolar_matches, triangulate_matches
from edgeslam_torch.mapping.refinement import choose_window, refine, refine_all
from edgeslam_torch.mapping.reobserve import MOST_DRIFT_PX, reobserve
from edgeslam_torch.mapping.slam_map import SlamMap
from edgeslam_torch.optim.problem import LmConfig, WindowResult
from edgeslam_torch.types import IntArray


class Mapper:
    """Takes keyframes into the map, one at a time."""

    def __init__(self, slam_map: SlamMap, camera: Camera, config: SlamConfig, lm: LmConfig) -> None:
        self.map = slam_map
        self.camera = camera
        self.orb = config.orb
        self.tracking = config.tracking
        self.config = config.mapping
        self.depth = config.depth
        self.lm = lm
        self._recent: IntArray = np.zeros(0, dtype=np.int64)

    def insert(self, keyframe: Keyframe, colour: np.ndarray) -> WindowResult | None:
        """Make the most of a new keyframe.

        Args:
            keyframe: Already in the map; ``keyframe.anchor`` holds what tracking matched.
            colour: RGB of each keypoint, ``(N, 3)`` uint8.

        Returns:
            What the window refinement reports, or None when there was nothing to refine.
        """
        with self.map.lock:
            self.map.anchors.begin_pass()
            self.cull_recent_anchors(keyframe)
            neighbours = self.map.covisible(keyframe, self.config.neighbours)
            self.triangulate_new(keyframe, neighbours, colour)
            fuse(self.map, self.camera, keyframe, self.map.covisible(keyframe, 2 * self.config.neighbours))
            drift_px = reobserve(self.map, self.camera, keyframe)
            self.map.join_pieces(keyframe, self.map.covisible(keyframe, len(self.map.keyframes)))
        if drift_px is not None and drift_px > MOST_DRIFT_PX:  # what drifted on the way lies outside the window
            refine_all(self.map, self.camera, self.lm)
        window = choose_window(self.map, keyframe, self.config.window, self.config.window_fixed)
        result = refine(self.map, window, self.camera, self.lm)
        with self.map.lock:
            # Refinement moves the others by too little to see them from another side.
            self.map.refresh_anchors(keyframe.anchor[keyframe.anchor >= 0])
            self.cull_keyframes(keyframe)
        return result

    def cull_recent_anchors(self, keyframe: Keyframe) -> None:
        """Remove young anchors that tracking does not find again or that only two keyframes ever saw."""
        anchors = self.map.anchors
        recent = self._recent[anchors.alive[self._recent]]
        age = keyframe.id - anchors.born[recent]
        rarely_found = anchors.found[recent] < 0.25 * anchors.visible[recent]
        lonely = (age >= 2) & (anchors.observations[recent] <= 2)
        self.map.remove_anchors(recent[rarely_found | lonely])
        self._recent = recent[~(rarely_found | lonely) & (age < 3)]

    def triangulate_new(self, keyframe: Keyframe, neighbours: list[Keyframe], colour: np.ndarray) -> None:
        """New anchors from keypoints that neither side has an anchor for yet."""
        prior, sigma = np.full((2, len(keyframe.anchor)), np.nan)
        free = np.flatnonzero(keyframe.anchor < 0)
        prior[free], sigma[free] = depth_prior(
            keyframe, keyframe.features.uv[free], self.map.anchors.p_w, self.depth.prior_sigma_log
        )
        if not np.isfinite(prior).any():
            return
        least_baseline = 0.01 * float(np.nanmedian(prior))
        new = [self._recent[:0]]
        for other in neighbours:
            if np.linalg.norm(other.centre_w - keyframe.centre_w) < least_baseline:
                continue
            matches = epipolar_matches(
                keyframe,
                other,
                self.camera,
                prior,
                sigma,
                self.orb.scale_factor,
                self.tracking.max_hamming,
                self.tracking.ratio,
            )
            p_w, sigma_ray, used = triangulate_matches(
                keyframe,
                other,
                matches,
                self.camera,
                self.orb.scale_factor,
                np.deg2rad(self.config.min_parallax_deg),
            )
            if len(p_w) == 0:
                continue
            mine, theirs = matches.query[used], matches.train[used]
            ids = self.map.anchors.add(p_w, keyframe.words[mine], keyframe.id, False, colour[mine])
            self.map.anchors.sigma[ids] = sigma_ray
            self.map.observe(keyframe, mine, ids)
            self.map.observe(other, theirs, ids)
            new.append(ids)
        ids = np.concatenate(new)
        self.map.refresh_anchors(ids)
        self._recent = np.concatenate([self._recent, ids])

    def cull_keyframes(self, newest: Keyframe) -> None:
        """Remove covisible keyframes whose anchors three others see at the same or finer scale; bound the map."""
        for other in self.map.covisible(newest, 2 * self.config.window):
            if other.id == 0 or newest.id - other.id < 3:
                continue
            held = other.anchor[other.anchor >= 0]
            if len(held) == 0 or np.mean(self.map.anchors.observations[held] >= 4) > self.config.redundancy:
                self.map.remove_keyframe(other)
        while len(self.map.keyframes) > self.config.max_keyframes:
            self.map.remove_keyframe(self._least_useful(newest))

    def _least_useful(self, newest: Keyframe) -> Keyframe:
        """The keyframe farthest from the newest, in position relative to the map's extent; ties to the oldest."""
        others = [k for k in self.map.keyframes.values() if newest.id - k.id >= self.config.window]
        distance = [float(np.linalg.norm(k.centre_w - newest.centre_w)) for k in others]
        return others[int(np.argmax(distance))]
