"""A map as plain arrays, to be saved and used by later flights.

Images are not saved: places are recognised by descriptors, and edges are already measured.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.files.tensor_file import Array
from edgeslam_torch.frontend.matching import words
from edgeslam_torch.geometry import se3, sim3
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.map.keyframe import NO_ANCHOR, Keyframe, make_keyframe
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.mapping.edges.edge_map import EdgeMap, EdgePoints
from edgeslam_torch.types import FloatArray, FrameFeatures, IntArray, ScaleEstimate

EARLIER_FLIGHT = "map of an earlier flight"
"""Origin of a submap that was read from a file."""
BEFORE_S = -np.inf
"""Stamp of keyframes of earlier flights, which have no time on this flight's clock."""

FARTHEST = 1e4
"""Distance from the origin [map units] beyond which an anchor is left out: it constrains directions only."""
UNKNOWN_SIGMA = 1e6
"""Represents an infinite standard deviation in the file."""


@dataclass(frozen=True, slots=True)
class SavedAtlas:
    """Submaps of one or several flights, in published units and axes."""

    camera: Camera
    """Camera of the undistorted pixels."""
    scale_factor: float
    """Scale factor between pyramid levels."""
    flights: tuple[str, ...]
    """Names of its recordings, oldest first."""
    scale: tuple[ScaleEstimate, ...]
    """Metres per unit of every submap, by its number."""
    arrays: dict[str, Array]
    """Columns of the tables of `edgeslam_torch.atlas.atlas_file.COLUMNS`."""

    @property
    def keyframes(self) -> int:
        """Number of keyframes."""
        return len(self.arrays["keyframe.id"])

    @property
    def anchors(self) -> int:
        """Number of anchors."""
        return len(self.arrays["anchor.p_w"])

    def summary(self) -> dict[str, int]:
        """For ``summary.json``."""
        return {"keyframes": self.keyframes, "anchors": self.anchors, "flights": len(self.flights)}


@dataclass(frozen=True, slots=True)
class Unit:
    """Units in which to save a submap."""

    S: FloatArray
    """``(4, 4)`` similarity from map to published units."""
    scale: ScaleEstimate
    """Metres per published unit."""


def pack(
    slam_map: SlamMap, edges: EdgeMap, camera: Camera, flights: tuple[str, ...], units: dict[int, Unit]
) -> SavedAtlas:
    """The whole map as arrays.

    Args:
        slam_map: Keyframes with anchors, and their anchors, are saved.
        edges: Measured edges; those of removed keyframes stay with these.
        camera: Camera of the keyframes.
        flights: Names of the recordings.
        units: Units of each submap, by its number; others are saved as they are, without metric scale.
    """
    keyframes, anchor = _worth_keeping(slam_map)
    alive = {k.id for k in keyframes}
    pieces = sorted({slam_map.piece_of(id) for id in alive})
    unit = [units.get(piece, Unit(np.eye(4), ScaleEstimate())) for piece in pieces]
    # Removed keyframes that host edges or depth priors are saved by their pose relative to a remaining one.
    hosts = [h for h in edges.hosts if len(h.uv) and slam_map.resolve(h.keyframe_id)[0] in alive]
    prior_hosts = slam_map.anchors.host[anchor][slam_map.anchors.from_depth[anchor]].tolist()
    removed = sorted({*prior_hosts, *(h.keyframe_id for h in hosts)} - alive)
    successors = {id: slam_map.resolve(id) for id in removed}
    piece_of = {k.id: pieces.index(slam_map.piece_of(k.id)) for k in keyframes}
    piece_of |= {id: piece_of[successor] for id, (successor, _) in successors.items()}
    number = {id: n for n, id in enumerate(sorted([*alive, *removed]))}
    S = [unit[piece_of[k.id]].S for k in keyframes]
    arrays = {
        "keyframe.id": _ints(number[k.id] for k in keyframes),
        "keyframe.piece": _ints(piece_of[k.id] for k in keyframes),
        "keyframe.T_c_w": np.array([sim3.moved_camera(s, k.T_c_w) for s, k in zip(S, keyframes, strict=True)]),
        "keyframe.keypoints": _ints(len(k.anchor) for k in keyframes),
        "removed.id": _ints(number[id] for id in removed),
        "removed.heir": _ints(number[successors[id][0]] for id in removed),
        "removed.T_removed_heir": _stacked(
            [se3.scaled(successors[id][1], sim3.scale_of(unit[piece_of[id]].S)) for id in removed], (4, 4)
        ),
        **_keypoints(keyframes, anchor, len(slam_map.anchors.alive)),
        **_anchors(slam_map, keyframes, anchor, S, number),
        **_edges(hosts, [sim3.scale_of(unit[piece_of[h.keyframe_id]].S) for h in hosts], number),
    }
    return SavedAtlas(camera, slam_map.scale_factor, flights, tuple(u.scale for u in unit), arrays)


def unpack(saved: SavedAtlas, slam_map: SlamMap, edges: EdgeMap, camera: Camera) -> None:
    """Load a saved atlas into an empty map.

    Args:
        saved: Consistent contents.
        slam_map: Receives keyframes and anchors; submaps keep their numbers.
        edges: Receives the measured edges.
        camera: Of the new flight; pixels are converted to it.
    """
    arrays = saved.arrays
    for _ in saved.scale:
        slam_map.add_piece(EARLIER_FLIGHT)
    anchor = _add_anchors(slam_map, arrays)
    uv = _converted(arrays["keypoint.uv"], saved.camera, camera)
    rows = _split(arrays["keyframe.keypoints"])
    for row, id in enumerate(arrays["keyframe.id"].tolist()):
        part = rows[row]
        features = FrameFeatures(
            uv[part],
            arrays["keypoint.octave"][part],
            arrays["keypoint.angle"][part],
            arrays["keypoint.descriptor"][part],
        )
        keyframe = make_keyframe(id, -1, BEFORE_S, arrays["keyframe.T_c_w"][row], features)
        metric = arrays["keypoint.anchor"][part]
        keyframe.anchor[:] = np.where(metric >= 0, anchor[metric], NO_ANCHOR)
        slam_map.restore_keyframe(keyframe, int(arrays["keyframe.piece"][row]))
    for id, successor, T in zip(
        arrays["removed.id"].tolist(), arrays["removed.heir"].tolist(), arrays["removed.T_removed_heir"], strict=True
    ):
        slam_map.restore_removed(id, successor, T)
    for id, part in zip(arrays["host.keyframe"].tolist(), _split(arrays["host.edges"]), strict=True):
        column = {name: arrays[f"edge.{name}"][part] for name in ("uv", "normal", "p_c", "sigma")}
        column = {name: values.astype(np.float64) for name, values in column.items()}
        column["uv"] = _converted(column["uv"], saved.camera, camera)
        rest = {name: arrays[f"edge.{name}"][part] for name in ("colour", "observations")}
        edges.hosts.append(EdgePoints(keyframe_id=id, **column, **rest))


def _worth_keeping(slam_map: SlamMap) -> tuple[list[Keyframe], IntArray]:
    """Keyframes with anchors, in order, and these anchors; without depth priors that have lost their host."""
    keyframes = [slam_map.keyframes[id] for id in sorted(slam_map.keyframes)]
    anchors, anchor = slam_map.anchors, slam_map.anchors_seen_by(keyframes)
    anchor = anchor[np.abs(anchors.p_w[anchor]).max(axis=1, initial=0.0) <= FARTHEST]
    alive = {k.id for k in keyframes if (k.anchor != NO_ANCHOR).any()}
    host = np.array([slam_map.resolve(int(h))[0] if h >= 0 else -1 for h in anchors.host[anchor]], dtype=np.int64)
    anchor = anchor[~anchors.from_depth[anchor] | np.isin(host, sorted(alive))]
    kept = np.zeros(len(anchors.alive) + 1, dtype=bool)  # the last row is for NO_ANCHOR
    kept[anchor] = True
    return [k for k in keyframes if kept[k.anchor].any()], anchor


def _keypoints(keyframes: list[Keyframe], anchor: IntArray, capacity: int) -> dict[str, Array]:
    row_of = np.full(capacity + 1, NO_ANCHOR, dtype=np.int64)  # the last row is for NO_ANCHOR
    row_of[anchor] = np.arange(len(anchor))
    row_of[-1] = NO_ANCHOR
    features = [k.features for k in keyframes]
    return {
        "keypoint.uv": _joined([f.uv for f in features], np.float32, (2,)),
        "keypoint.octave": _joined([f.octave for f in features], np.int32),
        "keypoint.angle": _joined([f.angle_rad for f in features], np.float32),
        "keypoint.descriptor": _joined([f.descriptors for f in features], np.uint8, (32,)),
        "keypoint.anchor": _joined([row_of[k.anchor] for k in keyframes], np.int64),
    }


def _anchors(
    slam_map: SlamMap, keyframes: list[Keyframe], anchor: IntArray, S: list[FloatArray], number: dict[int, int]
) -> dict[str, Array]:
    anchors = slam_map.anchors
    by = np.zeros(len(anchors.alive) + 1, dtype=np.int64)
    for row, keyframe in enumerate(keyframes):
        by[keyframe.anchor] = row
    seen_by = by[anchor]
    similarity = _stacked(S, (4, 4))[seen_by]
    scale = np.array([sim3.scale_of(s) for s in S] or [1.0])[seen_by]
    turn = similarity[:, :3, :3] / scale[:, None, None]
    guessed = anchors.from_depth[anchor]
    host = [number[h] if g else -1 for h, g in zip(anchors.host[anchor].tolist(), guessed.tolist(), strict=True)]
    return {
        "anchor.p_w": _moved(similarity, anchors.p_w[anchor]),
        "anchor.descriptor": np.ascontiguousarray(anchors.words[anchor]).view(np.uint8).reshape(-1, 32),
        "anchor.normal": np.einsum("nij,nj->ni", turn, anchors.normal[anchor]),
        "anchor.max_distance": anchors.max_distance[anchor] * scale,
        "anchor.colour": anchors.colour[anchor],
        "anchor.visible": anchors.visible[anchor],
        "anchor.found": anchors.found[anchor],
        "anchor.from_depth": guessed.astype(np.uint8),
        "anchor.host": _ints(host),
        "anchor.origin": np.where(guessed[:, None], _moved(similarity, anchors.origin[anchor]), 0.0),
        "anchor.prior": np.where(guessed[:, None], anchors.prior[anchor] / scale[:, None], 0.0),
        "anchor.sigma": np.minimum(anchors.sigma[anchor] * scale, UNKNOWN_SIGMA),
    }


def _edges(hosts: list[EdgePoints], scale: list[float], number: dict[int, int]) -> dict[str, Array]:
    return {
        "host.keyframe": _ints(number[h.keyframe_id] for h in hosts),
        "host.edges": _ints(len(h.uv) for h in hosts),
        "edge.uv": _joined([h.uv for h in hosts], np.float32, (2,)),
        "edge.normal": _joined([h.normal for h in hosts], np.float32, (2,)),
        "edge.p_c": _joined([s * h.p_c for s, h in zip(scale, hosts, strict=True)], np.float32, (3,)),
        "edge.sigma": _joined([s * h.sigma for s, h in zip(scale, hosts, strict=True)], np.float32),
        "edge.colour": _joined([h.colour for h in hosts], np.uint8, (3,)),
        "edge.observations": _joined([h.observations for h in hosts], np.int32),
    }


def _add_anchors(slam_map: SlamMap, arrays: dict[str, Array]) -> IntArray:
    """Ids of the anchors of the file's rows ``(A,)``."""
    anchors = slam_map.anchors
    descriptor = words(arrays["anchor.descriptor"])
    ids = anchors.add(arrays["anchor.p_w"], descriptor, -1, False, arrays["anchor.colour"])
    for name in ("normal", "max_distance", "visible", "found", "host", "origin", "prior"):
        getattr(anchors, name)[ids] = arrays[f"anchor.{name}"]
    anchors.from_depth[ids] = arrays["anchor.from_depth"].astype(bool)
    sigma = arrays["anchor.sigma"]
    anchors.sigma[ids] = np.where(sigma < UNKNOWN_SIGMA, sigma, np.inf)
    return ids


def _converted(uv: FloatArray, made_with: Camera, camera: Camera) -> FloatArray:
    """Undistorted pixels ``(N, 2)`` of one camera converted to another."""
    a, b = made_with, camera
    if (a.fx, a.fy, a.cx, a.cy) == (b.fx, b.fy, b.cx, b.cy):
        return uv
    ray = (uv - np.array([a.cx, a.cy])) / np.array([a.fx, a.fy])
    return (ray * np.array([b.fx, b.fy]) + np.array([b.cx, b.cy])).astype(uv.dtype)


def _moved(similarity: FloatArray, p: FloatArray) -> FloatArray:
    return np.einsum("nij,nj->ni", similarity[:, :3, :3], p) + similarity[:, :3, 3]


def _split(counts: IntArray) -> list[slice]:
    ends = np.cumsum(counts).tolist()
    return [slice(end - n, end) for n, end in zip(counts.tolist(), ends, strict=True)]


def _ints(values: Iterable[int]) -> IntArray:
    return np.array(list(values), dtype=np.int64)


def _stacked(rows: list[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(-1, *shape)


def _joined(parts: list[Array], dtype: type, shape: tuple[int, ...] = ()) -> Array:
    whole = np.concatenate(parts) if parts else np.zeros((0, *shape))
    return np.ascontiguousarray(whole.astype(dtype))
