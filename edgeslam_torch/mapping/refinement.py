"""Stage 4 on the map: select a window, refine it, write the result back, remove outliers."""

import math
from dataclasses import dataclass, replace

import numpy as np

from edgeslam_torch.estimation.displacement import TelemetryModel
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.robust_statistics import CHI2_2DOF_95
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.map.revisit import is_back
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.freed_depths import Weight, motion_priors
from edgeslam_torch.mapping.motion_terms import EFFECTIVE_SAMPLES, motion_factors
from edgeslam_torch.mapping.prior_anchors import depth_priors, mostly_on_priors
from edgeslam_torch.mapping.window_edges import WindowEdges
from edgeslam_torch.mapping.window_scale import MIN_EXTENT, with_same_depths
from edgeslam_torch.optim.local_ba import refine_window
from edgeslam_torch.optim.problem import (
    LmConfig,
    RelativePosePrior,
    ScalePrior,
    StopReason,
    WindowProblem,
    WindowResult,
)
from edgeslam_torch.types import IntArray

UNKNOWN_SCALE_LOG = 1.0
"""Standard deviation of the log of the metres per map unit if only the window's own telemetry determines it."""

SPOT = 0.5
"""Maximum distance of the cameras of a rotation on the spot, relative to the scene depth."""

_DRIFTED = 10
"""Number of newest keyframes, a small window, that may have drifted and do not define the scale of a wide one."""


@dataclass(frozen=True, slots=True)
class Window:
    """Keyframes to refine, keyframes that fix the gauge, and the anchors of the former."""

    free: list[Keyframe]
    fixed: list[Keyframe]
    anchor: IntArray
    freed: Weight = Weight.NONE
    """Correction of the bias by depth priors."""
    is_new_map: bool = False
    """Whether this is a whole new map, whose newest keyframe, the last free one, has the pose of tracking."""
    settled: bool = False
    """Whether only a converged result is written back: intermediate poses of the newest keyframes, against which
    tracking runs, are arbitrary."""
    effective_samples: float = EFFECTIVE_SAMPLES
    """Number of correlated reprojections that count as one relative to telemetry."""


def choose_window(slam_map: SlamMap, newest: Keyframe, free: int, fixed: int) -> Window:
    """The newest keyframe, its best covisible ones, and the next best as fixed poses.

    The oldest of the window is fixed if no outside keyframe observes its anchors, so that the gauge is always fixed.
    """
    members = [newest, *slam_map.covisible(newest, free - 1)]
    anchor = slam_map.anchors_seen_by(members)
    counts = slam_map.shared_counts(anchor)
    inside = {k.id for k in members}
    outside = sorted((id for id in counts if id not in inside), key=lambda id: (-counts[id], -id))[:fixed]
    frozen = [slam_map.keyframes[id] for id in outside]
    if len(frozen) < 2:  # one fixed pose leaves the scale free, two fix it
        members.sort(key=lambda k: -k.id)
        while len(frozen) < 2 and len(members) > 1:
            frozen.append(members.pop())
    return Window(members, frozen, slam_map.anchors_seen_by(members))


def new_map(slam_map: SlamMap, newest: Keyframe, most: int) -> Window | None:
    """The whole submap of the newest keyframe while it has at most ``most`` keyframes.

    A map initialised with wrong predicted depths confuses rotation with translation, which a window with two fixed
    poses, one of them wrong, cannot correct.
    None for fewer than three keyframes, or a camera that never moved.
    """
    piece = slam_map.piece_of(newest.id)
    keyframes = [k for id, k in sorted(slam_map.keyframes.items()) if slam_map.piece_of(id) == piece]
    if not 3 <= len(keyframes) <= most:
        return None
    window = Window(keyframes[1:], keyframes[:1], slam_map.anchors_seen_by(keyframes), is_new_map=True)
    return window if extent_prior(window) is not None else None


def recent_map(slam_map: SlamMap, newest: Keyframe, most: int) -> Window | None:
    """The newest ``most`` keyframes of a submap as one window.

    The earlier keyframe that shares most anchors is fixed, or its own first one without such; the depths of its older
    part fix the scale (`with_same_depths`), for which two neighbouring poses are too close. None for fewer than three
    keyframes, a camera that never moved, or a revisit of earlier ground: its scale is determined, and the telemetry of
    one more visit would move its anchors away from the keyframes that created them.
    """
    piece = slam_map.piece_of(newest.id)
    keyframes = [k for id, k in sorted(slam_map.keyframes.items()) if slam_map.piece_of(id) == piece]
    recent, earlier = keyframes[-most:], keyframes[:-most]
    anchor = slam_map.anchors_seen_by(recent)
    if earlier:
        if is_back(earlier, recent, np.array([SPOT * (slam_map.median_depth(k) or 0.0) for k in keyframes])):
            return None
        shared = slam_map.shared_counts(anchor)
        earlier.sort(key=lambda k: (-shared.get(k.id, 0), -k.id))
        window = Window(recent, earlier[:1], anchor, Weight.WIDE, settled=True)
    else:
        window = Window(recent[1:], recent[:1], anchor, Weight.WIDE, settled=True)
    return window if len(window.free) >= 2 and extent_prior(window) is not None else None


def refine_all(
    slam_map: SlamMap,
    camera: Camera,
    config: LmConfig,
    telemetry: TelemetryModel | None = None,
) -> WindowResult | None:
    """Refine every keyframe of the map jointly; None if there is nothing to refine, see `whole_map`."""
    window = whole_map(slam_map)
    return None if window is None else refine(slam_map, window, camera, config, telemetry)


def whole_map(
    slam_map: SlamMap, freed: Weight = Weight.NONE, effective_samples: float = EFFECTIVE_SAMPLES
) -> Window | None:
    """All keyframes as one window, the first pose fixed; None for fewer than three, or a camera that never moved."""
    keyframes = [slam_map.keyframes[id] for id in sorted(slam_map.keyframes)]
    if len(keyframes) < 3:
        return None
    window = Window(
        keyframes[1:], keyframes[:1], slam_map.anchors_seen_by(keyframes), freed, effective_samples=effective_samples
    )
    return window if extent_prior(window) is not None else None


def extent_prior(window: Window) -> ScalePrior | None:
    """Scale prior if only one pose is fixed: the distance to the farthest other pose. None if no pose is free.

    Two fixed poses fix the scale themselves; coincident poses have none. The newest pose of a new map is excluded, as
    it is not refined yet. In a loaded map it is the farthest loaded pose, which preserves the map's scale.
    """
    if len(window.fixed) != 1 or not window.free:
        return None
    centre = window.fixed[0].centre_w
    refined = window.free[:-1] if window.is_new_map else window.free
    distance = np.array([np.linalg.norm(k.centre_w - centre) for k in refined])
    earlier = np.array([math.isinf(k.stamp_s) for k in refined])
    if math.isinf(window.fixed[0].stamp_s) and (distance[earlier] >= MIN_EXTENT).any():
        distance = np.where(earlier, distance, 0.0)
    far = int(distance.argmax())
    if distance[far] < MIN_EXTENT:
        return None
    return ScalePrior(far, len(window.free), float(distance[far]), 1e-3)


def refine(
    slam_map: SlamMap,
    window: Window,
    camera: Camera,
    config: LmConfig,
    telemetry: TelemetryModel | None = None,
    edges: WindowEdges | None = None,
) -> WindowResult | None:
    """Refine the window in place, with its edges if given; outlier observations are removed from the map."""
    problem, keypoint = window_problem(slam_map, window, camera, config, telemetry)
    keyframes = [*window.free, *window.fixed]
    placed = None if edges is None else edges.place(problem, keyframes)
    problem = problem if placed is None else placed.problem
    if len(problem.obs_pose) == 0:
        if placed is None or not placed.has_terms:
            return None
        keypoint = [k[:0] for k in keypoint]
    result = refine_window(problem, config)
    if window.settled and not result.stop.converged:
        return result
    if problem.scale_priors and result.stop is not StopReason.NOT_FINITE:
        if window.is_new_map:
            result = with_same_depths(problem, result, len(window.free))
        elif window.settled:  # the newest may have drifted
            result = with_same_depths(problem, result, len(window.free), older=len(window.free) - _DRIFTED)
    with slam_map.lock:  # a consistent snapshot for readers
        write_back(slam_map, window, keypoint, result)
        if edges is not None and placed is not None and result.stop is not StopReason.NOT_FINITE:
            edges.write_back(keyframes, placed.edges, result.edge_inverse_depth)
    return result


def window_problem(
    slam_map: SlamMap, window: Window, camera: Camera, config: LmConfig, telemetry: TelemetryModel | None = None
) -> tuple[WindowProblem, list[IntArray]]:
    """A window's poses, anchors and observations, and the observations' keypoints of each keyframe.

    Poses come free ones first, those of hosts outside the window last. With plain squares (the paper's literal form,
    not ``robust``) keypoints have equal weight; otherwise they are whitened by octave or alignment.
    """
    keyframes = [*window.free, *window.fixed]
    row_of_anchor = np.full(len(slam_map.anchors.alive) + 1, -1, dtype=np.int64)
    row_of_anchor[window.anchor] = np.arange(len(window.anchor))
    row_of_anchor[-1] = -1
    keypoint: list[IntArray] = []
    pose = []
    for i, keyframe in enumerate(keyframes):
        seen = np.flatnonzero(row_of_anchor[keyframe.anchor] >= 0)
        keypoint.append(seen)
        pose.append(np.full(len(seen), i, dtype=np.int64))
    row = np.concatenate([row_of_anchor[k.anchor[s]] for k, s in zip(keyframes, keypoint, strict=True)])
    uv = np.concatenate([k.features.uv[s] for k, s in zip(keyframes, keypoint, strict=True)])
    octave = np.concatenate([k.features.octave[s] for k, s in zip(keyframes, keypoint, strict=True)])
    aligned = np.concatenate([k.aligned_px[s] for k, s in zip(keyframes, keypoint, strict=True)])
    growth = slam_map.scale_factor ** np.arange(slam_map.levels, dtype=np.float64)
    sigma_px = np.where(np.isnan(aligned), growth[octave], aligned)
    unsure = slam_map.anchors.from_depth[window.anchor]
    # If most depths have priors, these fix the scale; the distance between poses of a rotating camera is noise.
    extent = None if unsure.sum() > 0.5 * len(unsure) else extent_prior(window)
    priors, hosts = depth_priors(slam_map, window.anchor, [k.id for k in keyframes])
    # A single distance fixes the gauge and carries no information on the metric scale.
    doubt = UNKNOWN_SCALE_LOG if extent is not None else None
    reported = motion_factors(
        telemetry, keyframes, [slam_map.piece_of(k.id) for k in keyframes], doubt, window.effective_samples
    )
    motions = tracked_motions(slam_map, keyframes)
    problem = WindowProblem(
        T_c_w=np.stack([*(k.T_c_w for k in keyframes), *(slam_map.pose_of(id) for id in hosts)]),
        pose_fixed=np.arange(len(keyframes) + len(hosts)) >= len(window.free),
        p_w=slam_map.anchors.p_w[window.anchor],
        obs_pose=np.concatenate(pose),
        obs_anchor=row,
        uv=uv.astype(np.float64),
        inv_sigma=1.0 / sigma_px if config.robust else np.ones(len(row)),
        K=(camera.fx, camera.fy, camera.cx, camera.cy),
        relative_priors=motions,
        scale_priors=() if extent is None else (extent,),
        depth_priors=priors,
        centres=reported.centres,
        gravity=reported.gravity,
        headings=reported.headings,
    )
    return replace(problem, relative_priors=(*motions, *motion_priors(problem, window.freed))), keypoint


def tracked_motions(slam_map: SlamMap, keyframes: list[Keyframe]) -> tuple[RelativePosePrior, ...]:
    """Relative poses from tracking, as priors for keyframes of a window that see mostly anchors with depth priors.

    Joint refinement with such depths biases the pose of a camera that hardly moved: under translation every depth can
    fit its pixel's noise, under rotation none can. Tracking inflates the noise by the depths' uncertainty instead and
    is unbiased.
    """
    pose_of = {k.id: pose for pose, k in enumerate(keyframes)}
    motions = []
    for pose, keyframe in enumerate(keyframes):
        motion = keyframe.tracked
        if motion is None or motion.reference_id not in pose_of:
            continue
        if mostly_on_priors(slam_map.anchors, keyframe.anchor[keyframe.anchor >= 0]):
            motions.append(RelativePosePrior(pose_of[motion.reference_id], pose, motion.T_c_r, motion.information))
    return tuple(motions)


def write_back(slam_map: SlamMap, window: Window, keypoint: list[IntArray], result: WindowResult) -> None:
    """Write the result of `window_problem` back to the map; outlier observations are removed.

    They are kept if the solver ran out of steps: before convergence, residuals do not identify wrong observations, and
    a keyframe that loses correct ones is no longer constrained.
    """
    if result.stop is StopReason.NOT_FINITE:  # residuals are meaningless, so no observation is an outlier
        return
    keyframes = [*window.free, *window.fixed]
    with slam_map.lock:
        for keyframe, T_c_w in zip(keyframes, result.T_c_w, strict=False):  # hosts outside the window follow
            keyframe.T_c_w = T_c_w
        slam_map.anchors.p_w[window.anchor] = result.p_w
        if result.stop is StopReason.MAX_ITERATIONS:
            return
        bad = result.chi2 > CHI2_2DOF_95
        start = 0
        for keyframe, seen in zip(keyframes, keypoint, strict=True):
            wrong = seen[bad[start : start + len(seen)]]
            start += len(seen)
            slam_map.forget_observations(keyframe, wrong)
