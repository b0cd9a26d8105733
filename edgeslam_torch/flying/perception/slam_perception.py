"""Perception by SLAM from frames and state messages."""

import threading

import cv2
import numpy as np

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.estimation.scale.belief import disagreement
from edgeslam_torch.flying.perception.home import GROUND_M, Home, metres_per_unit
from edgeslam_torch.frontend.depth_network import DepthNetwork, open_depth, weights_path
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.navigation.drone_state import DroneState, View
from edgeslam_torch.navigation.map_views import MapUpdate, moves
from edgeslam_torch.navigation.near.depth import NearFit, fit_to_points
from edgeslam_torch.navigation.near.depth_bias import DepthBias
from edgeslam_torch.navigation.near.points import agreeing, seen_points, with_nearer_points
from edgeslam_torch.navigation.space import CELL_M, MAX_VIEWS
from edgeslam_torch.navigation.supervisor import SCALE_SIGMA
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.types import DepthMap, FloatArray, Frame, Health, SlamOutput, TelemetrySample

IMAGE_WIDTH = 480
"""Wider images are halved until they fit; flights are evaluated at this width."""
_WEIGHTS = "near"
"""Weights of the depth network for obstacles and openings; map points scale it."""
_DEPTH_EVERY = 3
"""Frames per depth map: 5 Hz."""
_STEP = 4
"""Subsampling of depth maps for the planner."""
_FRESH_M = 0.3, 6.0
"""Depth range in which edges of the current frame are triangulated."""
_LAST_FIT_S = 4.0
"""Time after a tracking loss in which the last depth fit is used: a bare wall has no points for a new one."""
_DARK, _FLAT = 25.0, 2.0
"""Mean and standard deviation [of 255] below which an image is dark or the lens covered; the network would predict
walls there. A bare wall has more contrast."""
_LOST = ("lost", "starting")
_DISAGREE_SIGMAS, _MEASURED = 3.0, {"telemetry", "height"}
_WIDEST_SIGMA_M = 0.2
_THINNED = 10
"""Thinning of old views, to one in two seconds, over which the map does not deform."""
_MOVES_EVERY_S = 3.0
"""Minimum time between map corrections at one scale; each makes the planner rebuild its grid."""


class SlamPerception:
    """Runs `EdgeSlam` on frames and state messages; poses are predicted over the video's latency.

    The world is that of `home` at the SLAM's best scale estimate, which may differ from its output unit.
    `add_telemetry` and `state` may be called from any thread, also during `seen`; `seen` from one thread.

    Args:
        camera: Camera of the frames.
        seed: Seed of the SLAM.
        realtime: Whether mapping runs in its own thread, as in flight, or synchronously, for repeatable runs.
    """

    def __init__(self, camera: Camera, seed: int = 0, realtime: bool = False) -> None:
        width, height = camera.width, camera.height
        while width > IMAGE_WIDTH and width % 2 == height % 2 == 0:
            width, height = width // 2, height // 2
        self._camera = camera.scaled(width, height)
        self._slam = EdgeSlam(self._camera, SlamConfig(seed=seed), realtime=realtime)
        self._K_small = self._camera.scaled(width // _STEP, height // _STEP).K
        self._network: DepthNetwork = open_depth(weights_path(_WEIGHTS))
        self._T_b_c = camera_on_body()
        self._lock = threading.Lock()
        self._samples: list[TelemetrySample] = []
        """Messages not yet processed by a SLAM step."""
        self._captured_s = 0.0
        self._battery = 1.0
        self._reported_height_m, self._reported_speed_m_s = np.nan, np.nan
        self._revision = self._changes = self._frames = 0
        """The second counts scale changes."""
        self._output: SlamOutput | None = None
        self._home = Home(np.eye(3), 1.0, np.zeros(3))
        self._fit: tuple[NearFit, float, int] | None = None
        """Last depth fit, arrival time of its frame, and its scale revision."""
        self._bias, self._unit = DepthBias(), (0, 1.0)
        """The second: scale revision, and metres per output unit in it."""
        self._metres = np.nan
        """Metres per map unit in use; NaN while the scale is unknown."""
        self._shown: tuple[FloatArray, float, int] = np.zeros((0, 4, 4)), 1.0, 0
        """At the last view: poses ``(F, 4, 4)`` of all frames, metres per map unit, and the revision."""
        self._sent_views: list[tuple[int, FloatArray]] = []
        """Frames whose views were sent to the planner, the newest of them with their poses as last sent."""
        self._sent_unit, self._sent_revision, self._moved_s = 1.0, 0, -np.inf

    def add_telemetry(self, sample: TelemetrySample) -> None:
        """Process a state message."""
        with self._lock:
            self._samples.append(sample)
            if np.isfinite(sample.battery):
                self._battery = sample.battery
            if np.isfinite(sample.height_m):
                self._reported_height_m = sample.height_m + GROUND_M
            self._reported_speed_m_s = float(np.linalg.norm(sample.velocity_m_s[:2]))

    def seen(self, image: np.ndarray, arrived_s: float, captured_s: float) -> View | None:
        """Process a frame ``(H, W, 3)`` BGR; every few frames yield a view with metric depth."""
        size = (self._camera.width, self._camera.height)
        if image.shape[1::-1] != size:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        with self._lock:
            batch = list(self._samples)
        output = self._slam.step(Frame(self._frames, arrived_s, image), batch)
        self._frames += 1
        revised, self._revision = output.revision != self._revision, output.revision
        shows = revised or self._frames % _DEPTH_EVERY == 0
        T_slam = self._slam.trajectory(None if shows else 1)[1]
        depth = self._depth(image, output) if shows else None
        # A new scale is only sent together with a view at that scale.
        late = captured_s - self._moved_s > _MOVES_EVERY_S
        metres = self._metres if depth is None else metres_per_unit(self._metres, output, late)
        unit = metres if np.isfinite(metres) else output.unit
        home = Home.of(T_slam[0], unit / output.unit, self._T_b_c)
        with self._lock:
            del self._samples[: len(batch)]
            self._output, self._captured_s, self._home = output, captured_s, home
            self._unit = output.revision, home.scale
            self._changes += int(np.isfinite(metres) and metres != self._metres)
            self._metres = metres
            if depth is not None:
                self._shown = home.poses(T_slam), unit, output.revision + self._changes
        return None if depth is None else self._view(depth, home, output.T_w_c, captured_s)

    def state(self, now_s: float, view: View | None = None) -> DroneState:
        """Current state, with a new view if any and the map correction since the last view."""
        with self._lock:
            output, captured_s, home, changes = self._output, self._captured_s, self._home, self._changes
            samples, battery = list(self._samples), self._battery
            reported_height_m, reported_speed_m_s = self._reported_height_m, self._reported_speed_m_s
        pose = self._slam.pose_now(now_s, samples)
        if pose is None or output is None or output.health is None:
            return DroneState(
                now_s,
                np.array([0.0, 0.0, GROUND_M]),
                0.0,
                np.zeros(3),
                metric=False,
                tracked=False,
                seen_s=captured_s,
                battery=battery,
                reported_height_m=reported_height_m,
                reported_speed_m_s=reported_speed_m_s,
            )
        health = output.health
        T_w_b = home.poses(pose.T_w_c) @ se3.inverse(self._T_b_c)
        relative = float(health.scale.sigma / health.scale.value)
        sigma = home.scale * float(np.sqrt(np.clip(np.trace(pose.covariance[:3, :3]) / 3.0, 0.0, None)))
        return DroneState(
            now_s,
            T_w_b[:3, 3],
            float(np.arctan2(T_w_b[1, 0], T_w_b[0, 0])),
            home.scale * (home.R @ np.asarray(pose.velocity_w)),
            position_sigma_m=min(sigma, _WIDEST_SIGMA_M),
            submap_sigma_m=home.scale * health.submap_sigma,
            drift_sigma_m=home.scale * health.drift_sigma,
            submap=output.piece,
            scale_sigma=relative if np.isfinite(relative) else 1.0,
            metric=health.metric,
            tracked=_tracks(output),
            conflict=_contradicted(health),
            seen_s=captured_s,
            battery=battery,
            reported_height_m=reported_height_m,
            reported_speed_m_s=reported_speed_m_s,
            view=view,
            revision=pose.revision + changes,
            map_update=None if view is None else self._map_update(view),
        )

    def close(self) -> None:
        """Stop the SLAM's threads."""
        self._slam.close()

    def _map_update(self, view: View) -> MapUpdate | None:
        """Correction of the views sent so far at the time of this one, which is added to them."""
        with self._lock:
            T_w_c, unit, revision = self._shown
            found = None
            if recent := self._sent_views[-MAX_VIEWS:]:
                sent = [*self._sent_views[:-MAX_VIEWS:_THINNED], *recent]
                pictures, before = np.array([picture for picture, _ in sent]), np.array([T for _, T in recent])
                T_w_c = T_w_c[pictures]
                after = T_w_c[-len(recent) :]
                late = view.stamp_s - self._moved_s > _MOVES_EVERY_S
                if revision != self._sent_revision or (late and moves(before, after, CELL_M)):
                    found, self._moved_s = MapUpdate(pictures, T_w_c, unit / self._sent_unit), view.stamp_s
                    self._sent_views[-len(recent) :] = zip(pictures[-len(recent) :].tolist(), after, strict=True)
            self._sent_views.append((view.picture, view.T_w_c))
            self._sent_unit, self._sent_revision = unit, revision
        return found

    def _depth(self, image: np.ndarray, output: SlamOutput) -> DepthMap | None:
        """Subsampled depth in output units: network depth scaled by map points, and the points in front of it.

        None with too few points.
        """
        if not _tracks(output) and (self._last_fit(output) is None or not _shows(image)):
            return None
        image = self._camera.undistort_image(image)
        depth, T_w_c = self._network(image, self._camera), output.T_w_c
        anchors, edges = self._slam.surroundings()
        fit = (self._fitted(depth, anchors, output) if _tracks(output) else None) or self._last_fit(output)
        if fit is None:
            return None
        fitted = fit.applied(depth)
        part = (slice(_STEP // 2, None, _STEP), slice(_STEP // 2, None, _STEP))
        small = DepthMap(fitted.depth_m[part], fitted.sigma_log[part])
        uv, z = seen_points(np.concatenate([anchors, edges]), self._K_small, T_w_c, small.depth_m.shape)
        if _tracks(output):
            fresh_uv, fresh_z = self._slam.fresh_edges(image, *(m / self._home.scale for m in _FRESH_M))
            uv, z = np.concatenate([uv, (fresh_uv + 0.5) / _STEP - 0.5]), np.concatenate([z, fresh_z])
        kept = agreeing(uv, z, small.depth_m.shape[1])
        return with_nearer_points(small, uv[kept], z[kept])

    def _fitted(self, depth: DepthMap, anchors: FloatArray, output: SlamOutput) -> NearFit | None:
        """Fit of network depth to the map's points in view, kept for frames without points.

        Only nearby points: with the whole map, occluded points of the next room would outnumber the visible ones.
        """
        fit = fit_to_points(depth, *seen_points(anchors, self._camera.K, output.T_w_c, depth.depth_m.shape))
        revision, unit_m = self._unit
        if revision == output.revision:
            consistent = fit is not None and self._bias.is_consistent(fit, unit_m, _is_sure(output))
            bias = self._bias.line(unit_m)
            if fit is None or not consistent:
                fit = bias
            elif bias is not None:
                fit = bias.through(fit)
        if fit is not None:
            self._fit = fit.alone(), output.stamp_s, output.revision
        return fit

    def _last_fit(self, output: SlamOutput) -> NearFit | None:
        """The last fit, for frames without tracking; None if too old or at another scale."""
        if self._fit is None:
            return None
        fit, at_s, revision = self._fit
        return fit if output.stamp_s - at_s < _LAST_FIT_S and output.revision == revision else None

    def _view(self, depth: DepthMap, home: Home, T_w_c: FloatArray, captured_s: float) -> View:
        """A metric view from depth in output units."""
        metres = home.scale * depth.depth_m
        return View(captured_s, metres, depth.sigma_log, self._K_small, home.poses(T_w_c), self._frames - 1)


def _is_sure(output: SlamOutput) -> bool:
    """Whether the scale is certain enough for the supervisor."""
    return output.metric and output.scale.sigma <= SCALE_SIGMA * output.scale.value


def _tracks(output: SlamOutput) -> bool:
    return output.health is not None and output.health.state not in _LOST


def _contradicted(health: Health) -> bool:
    """Whether scale sources contradict each other unresolved; velocities and heights that agree outvote the depth
    network, which may be outside its training domain."""
    confirmed = set(health.scale.source.split("+")) >= _MEASURED
    checked = [s for s in health.sources if s.source in _MEASURED] if confirmed else health.sources
    return disagreement(checked) > _DISAGREE_SIGMAS


def _shows(image: np.ndarray) -> bool:
    """Whether an image shows anything, if only a bare wall."""
    return bool(image.mean() > _DARK and image.std() > _FLAT)
