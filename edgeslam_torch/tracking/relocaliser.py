"""Find the pose of a frame with no useful prediction, from keyframes it looks like."""

import cv2
import numpy as np

from edgeslam_torch.frontend.matching import match_all
from edgeslam_torch.geometry import se3
from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.tracking.tracker import Track, Tracker, View
from edgeslam_torch.types import FloatArray

MIN_MATCHES = 20


def relocalise(tracker: Tracker, view: View, T_predicted: FloatArray, keyframes: int, attempt: int) -> Track | None:
    """Try some keyframes: the newest and the ones nearest to the prediction first, then all others in turn.

    Args:
        tracker: With the map to look in.
        view: Frame without a pose.
        T_predicted: ``(4, 4)`` world-to-camera guess.
        keyframes: How many to try now.
        attempt: Frames lost so far; shifts the turn.
    """
    for keyframe in _candidates(tracker, T_predicted, keyframes, attempt):
        track = _against(tracker, view, keyframe)
        if track is not None:
            return track
    return None


def _candidates(tracker: Tracker, T_predicted: FloatArray, count: int, attempt: int) -> list[Keyframe]:
    all_keyframes = sorted(tracker.map.keyframes.values(), key=lambda k: -k.id)
    if len(all_keyframes) <= count:
        return all_keyframes
    centre = se3.inverse(T_predicted)[:3, 3]
    near = sorted(all_keyframes, key=lambda k: float(np.linalg.norm(k.centre_w - centre)))
    half = count // 2
    start = attempt * (count - half) % len(all_keyframes)
    turn = (all_keyframes[start:] + all_keyframes[:start])[: count - half]
    return list({k.id: k for k in [*near[:half], *turn]}.values())


def _against(tracker: Tracker, view: View, keyframe: Keyframe) -> Track | None:
    held = keyframe.keypoints_with_anchor()
    if len(held) < MIN_MATCHES:
        return None
    config, camera, anchors = tracker.config, tracker.camera, tracker.map.anchors
    matches = match_all(keyframe.words[held], view.words, config.max_hamming, config.ratio)
    if len(matches) < MIN_MATCHES:
        return None
    ids = keyframe.anchor[held[matches.query]]
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
    if first is None or first.inliers < 10:
        return None
    track = tracker.track(view, first.T_c_w, first.anchor)
    # A wrong pose rarely explains much more of the map than the matches that made it.
    return track if track is not None and track.inliers >= 2 * config.min_inliers else None
