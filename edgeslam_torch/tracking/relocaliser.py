"""Relocalisation of a frame without a useful prediction, with verification against perceptual aliasing.

A repeated pattern (tiles, shelves, the doors of a corridor) matches a wrong place with dozens of inliers, and mapping
from there confirms the error. The number of inliers is therefore insufficient. A place is accepted by the share of
visible anchors that are found, their spread over the image, reachability, absence of an equally good rival, and
agreement of the following frames.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from edgeslam_torch.frontend.matching import match_all
from edgeslam_torch.geometry import se3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.tracking.tracker import MIN_ROUGH, Track, Tracker, View
from edgeslam_torch.types import FloatArray

MIN_MATCHES = 20
LIKELY_SHARE = 0.12
"""Minimum share of found anchors among those in view (or among the frame's keypoints, if fewer) of a likely place.
Wrong places reach 0.09 in a corridor with repeated doors; right ones have at least 0.2 in 95 % of frames of an office
(docs/decisions/18-relocalisation.md)."""
SURE_SHARE = 0.2
"""The same for a place within reach that needs no further confirmation. While the reachable region is a single place,
as in the first 0.2 s, a likely one is accepted."""
GRID = (8, 6)
"""Grid of cells for measuring the spread over the image."""
MIN_CELLS = 6
"""Minimum number of cells with an inlier: a single poster fills four."""
LIKELY_SPREAD = 0.3
"""Minimum share of cells with an inlier among those with an anchor in view: 0.24 at wrong
places, 0.4 and more at right ones."""
AGREEING_FRAMES = 3
"""Consecutive frames that must agree on a likely place."""
RIVAL = 0.6
"""Share of the best place's inliers above which another place is a rival."""
MAX_DISTANCE = 0.15
"""Maximum distance of two poses of one place, relative to the scene depth; also of consecutive frames."""
MAX_ANGLE_RAD = np.deg2rad(20.0)
MIN_PERIOD = 1.0 / 3.0
"""Minimum period of repetitive structure relative to the scene depth: doors every 1.9 m, seen from 3 to 5 m."""
ACCELERATION_M_S2 = 9.0
ANGULAR_ACCELERATION_RAD_S2 = 60.0
"""Bounds for a hand or a small drone: three times the standard deviations of the motion model."""


@dataclass(frozen=True, slots=True)
class Reach:
    """Region that the camera can have reached."""

    T_c_w: FloatArray
    """``(4, 4)`` expected pose, from the last velocity or from telemetry."""
    shift_m: float
    """Radius of the region."""
    turn_rad: float
    metre: float | None = None
    """Its length [map units]; a third of the scene depth if unknown."""

    def holds(self, place: "Place") -> bool:
        """Whether a place is within reach, with a tolerance."""
        shift, turn = pose_difference(place.track.T_c_w, self.T_c_w)
        near = shift <= self._shift(place.depth) + MAX_DISTANCE * place.depth
        return near and turn <= self.turn_rad + MAX_ANGLE_RAD

    def leaves_only(self, place: "Place") -> bool:
        """Whether aliasing is excluded: the reachable region is one place, or the place is where the camera is expected
        and the next similar one is out of reach."""
        near = self._shift(place.depth)
        if near <= MAX_DISTANCE * place.depth:
            return self.holds(place)
        shift, turn = pose_difference(place.track.T_c_w, self.T_c_w)
        return near <= MIN_PERIOD * place.depth and shift <= MAX_DISTANCE * place.depth and turn <= MAX_ANGLE_RAD

    def _shift(self, depth: float) -> float:
        return self.shift_m * (self.metre or depth / 3.0)


def reach_after(seconds: float, T_predicted: FloatArray, metre: float | None) -> Reach:
    """Region reachable some time after the last pose."""
    half = 0.5 * seconds**2
    return Reach(T_predicted, half * ACCELERATION_M_S2, half * ANGULAR_ACCELERATION_RAD_S2, metre)


@dataclass(frozen=True, slots=True)
class Place:
    """A candidate place of a frame, with its evidence."""

    track: Track
    share: float
    """Share of found anchors."""
    cells: int
    """Cells of the image with an inlier."""
    spread: float
    """Cells with an inlier, of those with an anchor that should be seen."""
    depth: float
    """Median depth of the anchors that should be seen [map units]."""

    def is_as(self, other: "Place") -> bool:
        """Whether two poses belong to one place."""
        shift, turn = pose_difference(self.track.T_c_w, other.track.T_c_w)
        return shift <= MAX_DISTANCE * min(self.depth, other.depth) and turn <= MAX_ANGLE_RAD


@dataclass(frozen=True, slots=True)
class Found:
    """A relocalised frame, with the earlier frames that confirmed it."""

    track: Track
    earlier: dict[int, FloatArray]
    """``T_c_w`` of frames before this one, by their index."""


class Relocaliser:
    """Relocalises frames against keyframes; stores likely but unconfirmed places between frames."""

    def __init__(self, tracker: Tracker) -> None:
        self.tracker = tracker
        self._waiting: list[tuple[int, Place]] = []
        """Index and place of the last consistent frames."""

    def forget(self) -> None:
        """Reset, after relocalisation or for a new map."""
        self._waiting = []

    @property
    def waiting(self) -> int:
        """Number of consecutive frames that agree on a likely place."""
        return len(self._waiting)

    def find(self, index: int, view: View, candidates: list[Keyframe], reach: Reach) -> Found | None:
        """Pose of a lost frame, if verified.

        Args:
            index: Of the frame.
            view: Its features.
            candidates: Keyframes to match.
            reach: Region that the camera can have reached.
        """
        place = self._only_place(self._places(view, candidates), reach)
        if place is None:
            self.forget()
            return None
        if self._waiting and not place.is_as(self._waiting[-1][1]):
            self.forget()
        self._waiting.append((index, place))
        sure = reach.leaves_only(place) or (reach.holds(place) and place.share >= SURE_SHARE)
        if not sure and len(self._waiting) < AGREEING_FRAMES:
            return None
        earlier = {i: p.track.T_c_w for i, p in self._waiting[:-1]}
        self.forget()
        return Found(place.track, earlier)

    def _places(self, view: View, candidates: list[Keyframe]) -> list[Place]:
        tracks = [match_keyframe(self.tracker, view, keyframe) for keyframe in candidates]
        if self._waiting:
            last = self._waiting[-1][1].track
            tracks.append(self.tracker.track(view, last.T_c_w, last.anchor))
        return [place_of(self.tracker, view, track) for track in tracks if track is not None]

    def _only_place(self, places: list[Place], reach: Reach) -> Place | None:
        """The best place if it is likely and without a rival; of two rivals, the one within reach."""
        places = sorted(places, key=lambda place: -place.track.inliers)
        if places and reach.leaves_only(places[0]):
            return places[0] if self._is_wide(places[0], self.tracker.config.min_inliers) else None
        rivals = [p for p in places if p.track.inliers > RIVAL * places[0].track.inliers]
        if not all(p.is_as(rivals[0]) for p in rivals):
            rivals = [p for p in rivals if reach.holds(p)]
        if not rivals or not all(p.is_as(rivals[0]) for p in rivals):
            return None
        enough = self._is_wide(rivals[0], 2 * self.tracker.config.min_inliers)
        return rivals[0] if enough and rivals[0].share >= LIKELY_SHARE else None

    def _is_wide(self, place: Place, inliers: int) -> bool:
        """Whether enough anchors agree over enough of the image."""
        return place.track.inliers >= inliers and place.cells >= MIN_CELLS and place.spread >= LIKELY_SPREAD


def place_of(tracker: Tracker, view: View, track: Track) -> Place:
    """Evidence for a pose."""
    seen = tracker.expected(track.T_c_w, tracker.map.anchors_seen_by(tracker.local_keyframes(track.anchor)))
    possible = max(1, min(len(seen.anchor), len(view.features.uv)))
    depth = float(np.median(seen.depth)) if len(seen.depth) else 0.0
    filled, could = cells_of(tracker.camera, view.features.uv[track.keypoint]), cells_of(tracker.camera, seen.uv)
    return Place(track, track.inliers / possible, len(filled), len(filled) / max(1, len(could)), depth)


def cells_of(camera: Camera, uv: FloatArray) -> set[tuple[int, int]]:
    """Cells of the image that contain a pixel."""
    cells = (uv // (np.array([camera.width, camera.height]) / GRID)).astype(np.int64)
    return set(map(tuple, cells.tolist()))


def candidates(tracker: Tracker, T_predicted: FloatArray, count: int, attempt: int) -> list[Keyframe]:
    """Keyframes to match: some of the nearest to the prediction first, then the others in rotation.

    Args:
        tracker: Holds the map.
        T_predicted: ``(4, 4)`` world-to-camera guess.
        count: Number of keyframes.
        attempt: Frames lost so far; selects the rotation.
    """
    all_keyframes = sorted(tracker.map.keyframes.values(), key=lambda k: -k.id)
    if len(all_keyframes) <= count:
        return all_keyframes
    centre = se3.inverse(T_predicted)[:3, 3]
    near = sorted(all_keyframes, key=lambda k: float(np.linalg.norm(k.centre_w - centre)))
    half = count // 2
    start = attempt * (count - half) % len(all_keyframes)
    turn = (all_keyframes[start:] + all_keyframes[:start])[: count - half]
    return list({k.id: k for k in [*near[:half], *turn]}.values())


def match_keyframe(tracker: Tracker, view: View, keyframe: Keyframe) -> Track | None:
    """Pose of a frame from one similar keyframe, refined on the local map."""
    observed = keyframe.keypoints_with_anchor()
    if len(observed) < MIN_MATCHES:
        return None
    camera, anchors = tracker.camera, tracker.map.anchors
    matches = match_all(keyframe.words[observed], view.words)
    if len(matches) < MIN_MATCHES:
        return None
    ids = keyframe.anchor[observed[matches.query]]
    uv = view.features.uv[matches.train].astype(np.float64)
    ok, rvec, tvec, inliers = cv2.solvePnPRansac(
        anchors.p_w[ids], uv, camera.K, None, iterationsCount=100, reprojectionError=4.0, flags=cv2.SOLVEPNP_EPNP
    )
    if not ok or inliers is None or len(inliers) < 12:
        return None
    T_c_w = np.eye(4)
    T_c_w[:3, :3], T_c_w[:3, 3] = cv2.Rodrigues(rvec)[0], tvec[:, 0]
    kept = inliers.ravel()
    first = tracker.solve(view, T_c_w, matches.train[kept], ids[kept])
    if first is None or first.inliers < MIN_ROUGH:
        return None
    return tracker.track(view, first.T_c_w, first.anchor)


def pose_difference(T_c_w: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Distance of two cameras [map units] and the rotation between them [rad]."""
    centre, there = (-T[:3, :3].T @ T[:3, 3] for T in (T_c_w, other))
    cosine = 0.5 * (float(np.trace(T_c_w[:3, :3] @ other[:3, :3].T)) - 1.0)
    return float(np.linalg.norm(centre - there)), float(np.arccos(np.clip(cosine, -1.0, 1.0)))
