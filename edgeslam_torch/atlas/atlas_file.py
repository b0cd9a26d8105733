"""File format of a saved atlas: safetensors with a JSON header, validated as a whole before use.

A truncated, damaged or hostile file, one of a newer version or of another lens is refused in one line.
"""

import dataclasses
import json
import math
import reprlib
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch.atlas.saved import SavedAtlas
from edgeslam_torch.errors import AtlasError, CalibrationError
from edgeslam_torch.files.plain import open_plain
from edgeslam_torch.files.tensor_file import KINDS, Array, Damaged, Entry, read_entries, write_tensors
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.lens import check_camera
from edgeslam_torch.types import FloatArray, IntArray, ScaleEstimate

HEADER_KEY = "edgeslam_atlas"
VERSION = 1
MAX_FILE_BYTES = 1 << 30
"""Maximum file size: 200 keyframes with 400 000 edge points have 25 MB."""
MAX_NUMBER = 1e6
"""Maximum absolute value of a length: kilometres in any map unit."""
LEAST_SIGMA = 1e-4
"""Minimum relative standard deviation of a metric scale; telemetry and depth reach 1 %."""
PLAUSIBLE_M = (0.02, 500.0)
"""Plausible median distance of a map's points from its keyframes [m]."""
MAX_PIECES, MAX_FLIGHTS, MAX_LEVELS = 1000, 1000, 20

COLUMNS: dict[str, tuple[str, tuple[int, ...]]] = {
    "keyframe.id": ("I64", ()),
    "keyframe.piece": ("I64", ()),
    "keyframe.T_c_w": ("F64", (4, 4)),
    "keyframe.keypoints": ("I64", ()),
    "keypoint.uv": ("F32", (2,)),
    "keypoint.octave": ("I32", ()),
    "keypoint.angle": ("F32", ()),
    "keypoint.descriptor": ("U8", (32,)),
    "keypoint.anchor": ("I64", ()),
    "removed.id": ("I64", ()),
    "removed.heir": ("I64", ()),
    "removed.T_removed_heir": ("F64", (4, 4)),
    "anchor.p_w": ("F64", (3,)),
    "anchor.descriptor": ("U8", (32,)),
    "anchor.normal": ("F64", (3,)),
    "anchor.max_distance": ("F64", ()),
    "anchor.colour": ("U8", (3,)),
    "anchor.visible": ("I64", ()),
    "anchor.found": ("I64", ()),
    "anchor.from_depth": ("U8", ()),
    "anchor.host": ("I64", ()),
    "anchor.origin": ("F64", (3,)),
    "anchor.prior": ("F64", (2,)),
    "anchor.sigma": ("F64", ()),
    "host.keyframe": ("I64", ()),
    "host.edges": ("I64", ()),
    "edge.uv": ("F32", (2,)),
    "edge.normal": ("F32", (2,)),
    "edge.p_c": ("F32", (3,)),
    "edge.sigma": ("F32", ()),
    "edge.colour": ("U8", (3,)),
    "edge.observations": ("I32", ()),
}
"""Type and row shape of every column. Columns of one table (the name before the dot) have the same number of rows;
keypoints are ordered by keyframe, edges by host."""


def write_atlas(path: Path, atlas: SavedAtlas) -> None:
    """Write an atlas, atomically.

    Raises:
        OSError: If the file cannot be written.
    """
    header = {
        "version": VERSION,
        "camera": dataclasses.asdict(atlas.camera),
        "scale_factor": atlas.scale_factor,
        "flights": atlas.flights[-MAX_FLIGHTS:],
        "pieces": [_piece(scale) for scale in atlas.scale],
    }
    arrays = {name: atlas.arrays[name].astype(KINDS[kind], copy=False) for name, (kind, _) in COLUMNS.items()}
    write_tensors(path, {HEADER_KEY: json.dumps(header)}, arrays)


def read_atlas(path: Path) -> SavedAtlas:
    """Read and check an atlas.

    Raises:
        AtlasError: If it is missing or invalid; one line with the file's name.
    """
    if not path.is_file():
        raise AtlasError(f"{path}: no such atlas file")
    try:
        if path.stat().st_size > MAX_FILE_BYTES:
            raise Damaged(f"larger than any atlas ({MAX_FILE_BYTES >> 20} MiB)")
        with path.open("rb") as file:
            remarks, entries = read_entries(file, {kind: dtype.itemsize for kind, dtype in KINDS.items()})
            atlas = _header(remarks.get(HEADER_KEY), _arrays(entries) if HEADER_KEY in remarks else {})
        _check(atlas)
    except OSError as error:
        raise AtlasError(f"{path}: cannot read the atlas ({error.strerror or error})") from error
    except ValueError as error:
        raise AtlasError(f"{path}: not a valid atlas: {' '.join(str(error).split())[:200]}") from None
    return atlas


def is_atlas(path: Path) -> bool:
    """Whether a file is an atlas of any version, valid or not, so that a newer one may replace it."""
    try:
        with open_plain(path) as file:
            remarks, _ = read_entries(file, {kind: dtype.itemsize for kind, dtype in KINDS.items()})
    except (OSError, ValueError):
        return False
    return HEADER_KEY in remarks


def check_fits(atlas: SavedAtlas, camera: Camera, scale_factor: float, path: Path, levels: int = MAX_LEVELS) -> None:
    """Refuse an atlas from another lens, or with another image pyramid.

    Raises:
        AtlasError: If keypoints would be searched at the wrong pyramid level.
    """
    made, now = (f"{c.width}x{c.height}, f {c.fx:.0f} px" for c in (atlas.camera, camera))
    if max(abs(math.log(atlas.camera.fx / camera.fx)), abs(math.log(atlas.camera.fy / camera.fy))) > math.log(1.2):
        raise AtlasError(f"{path}: made with another camera ({made}; this one: {now})")
    if atlas.scale_factor != scale_factor:
        raise AtlasError(f"{path}: made with orb.scale_factor {atlas.scale_factor:g}, this run has {scale_factor:g}")
    used = int(atlas.arrays["keypoint.octave"].max(initial=0)) + 1
    if used > levels:
        raise AtlasError(f"{path}: made with orb.levels {used}, this run has {levels}; give --set orb.levels={used}")


def _piece(scale: ScaleEstimate) -> dict[str, Any]:
    known = math.isfinite(scale.sigma)
    return {"metres": scale.value, "sigma": scale.sigma, "source": scale.source} if known else {}


# -- header ------------------------------------------------------------------------------------------------------


def _header(text: object, arrays: dict[str, Array]) -> SavedAtlas:
    """The atlas, from a valid header.

    Raises:
        ValueError: If it is invalid.
    """
    if not isinstance(text, str):
        raise Damaged("it contains no atlas")
    try:
        record = json.loads(text)
    except RecursionError:
        raise Damaged("its header is nested too deeply") from None
    if not isinstance(record, dict):
        raise Damaged("its header is not a table")
    if record.get("version") != VERSION:
        raise Damaged(f"version {reprlib.repr(record.get('version'))}; this program reads version {VERSION}")
    flights, pieces = record.get("flights"), record.get("pieces")
    if not (isinstance(flights, list) and len(flights) <= MAX_FLIGHTS and all(isinstance(f, str) for f in flights)):
        raise Damaged("its header does not name its flights")
    if not (isinstance(pieces, list) and 1 <= len(pieces) <= MAX_PIECES):
        raise Damaged("its header has no list of pieces")
    factor = _number(record.get("scale_factor"), 1.0, 2.0, "scale_factor")
    names = tuple(f[:200] for f in flights)
    return SavedAtlas(_camera(record.get("camera")), factor, names, tuple(_scale(p) for p in pieces), arrays)


def _camera(record: object) -> Camera:
    try:
        assert isinstance(record, dict)
        values: dict[str, Any] = {f.name: record[f.name] for f in dataclasses.fields(Camera)}
        distortion = tuple(_number(k, -MAX_NUMBER, MAX_NUMBER, "distortion") for k in values.pop("distortion"))
        source = str(values.pop("source"))[:200]
        lengths = {name: _number(values[name], 0.0, MAX_NUMBER, name) for name in ("fx", "fy", "focal_sigma")}
        centre = {name: _number(values[name], -MAX_NUMBER, MAX_NUMBER, name) for name in ("cx", "cy")}
        width, height = (int(_number(values[name], 1.0, MAX_NUMBER, name)) for name in ("width", "height"))
        camera = Camera(width, height, **lengths, **centre, distortion=distortion, source=source)
        if len(distortion) != 5:
            raise ValueError("distortion must have 5 numbers")
        check_camera(camera)
    except (AssertionError, KeyError, TypeError, CalibrationError) as error:
        raise Damaged(f"the camera in its header is invalid ({reprlib.repr(str(error))})") from None
    return camera


def _scale(record: object) -> ScaleEstimate:
    if not isinstance(record, dict):
        raise Damaged("its header has no list of pieces")
    if "metres" not in record:
        return ScaleEstimate()
    value = _number(record["metres"], 1e-6, 1e6, "metres")
    sigma = _number(record.get("sigma"), 0.0, 1e6, "sigma")
    if not sigma > 0.0:
        raise Damaged("sigma must be positive")
    return ScaleEstimate(value, sigma, str(record.get("source"))[:40])


def _number(value: object, low: float, high: float, name: str) -> float:
    """A number in a range; NaN is in none."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not low <= value <= high:
        raise Damaged(f"{name} must be a number from {low:g} to {high:g}, got {reprlib.repr(value)}")
    return float(value)


# -- arrays ------------------------------------------------------------------------------------------------------


def _arrays(entries: dict[str, Entry]) -> dict[str, Array]:
    """All columns, with equal numbers of rows within a table."""
    rows: dict[str, int] = {}
    for name, (kind, shape) in COLUMNS.items():
        entry = entries.get(name)
        if entry is None:
            raise Damaged(f"it has no column {name}")
        if entry.kind != kind or len(entry.shape) != 1 + len(shape) or entry.shape[1:] != shape:
            raise Damaged(f"its column {name} is {entry.kind} of shape {entry.shape}")
        table = name.partition(".")[0]
        if rows.setdefault(table, entry.shape[0]) != entry.shape[0]:
            raise Damaged(f"its column {name} has {entry.shape[0]} rows, others of its table {rows[table]}")
    return {name: entries[name].array() for name in COLUMNS}


def _check(atlas: SavedAtlas) -> None:
    """Raise `Damaged` if the tables are inconsistent."""
    a = atlas.arrays
    for name, values in a.items():
        if values.dtype.kind == "f" and not np.abs(values).max(initial=0.0) <= MAX_NUMBER:
            raise Damaged(f"{name} has values that are not finite or beyond {MAX_NUMBER:g}")
    if atlas.keyframes == 0:
        raise Damaged("it has no keyframe")
    ids = np.concatenate([a["keyframe.id"], a["removed.id"]])
    _require((np.sort(ids) == np.arange(len(ids))).all(), "keyframes are not numbered consecutively")
    _require(bool(np.isin(a["removed.heir"], a["keyframe.id"]).all()), "a removed keyframe has no successor")
    pieces = np.unique(a["keyframe.piece"])
    _require(np.array_equal(pieces, np.arange(len(atlas.scale))), "pieces and keyframes do not match")
    _require(_are_poses(a["keyframe.T_c_w"]) and _are_poses(a["removed.T_removed_heir"]), "a pose is not rigid")
    _require(_divides(a["keyframe.keypoints"], len(a["keypoint.anchor"])), "keypoints do not add up")
    _require(_divides(a["host.edges"], len(a["edge.sigma"])), "edges do not add up")
    _require(_within(a["host.keyframe"], 0, len(ids)), "edges refer to a missing keyframe")
    _require(_within(a["keypoint.octave"], 0, MAX_LEVELS), "a keypoint has an invalid pyramid level")
    _check_anchors(a, len(ids))
    _check_metres(atlas)
    size = np.array([atlas.camera.width, atlas.camera.height])
    for name in ("keypoint.uv", "edge.uv"):
        _require(((a[name] >= -size) & (a[name] <= 2 * size)).all(), f"{name} is far outside the image")


def _check_metres(atlas: SavedAtlas) -> None:
    """Refuse a metric scale of impossible accuracy, or one that puts points at implausible distances."""
    a = atlas.arrays
    for piece, scale in enumerate(atlas.scale):
        if not math.isfinite(scale.sigma):
            continue
        if scale.sigma < LEAST_SIGMA * scale.value:
            raise Damaged(f"its scale of {scale.value:g} metres a unit has an implausible sigma of {scale.sigma:g}")
        rows = np.flatnonzero(a["keyframe.piece"] == piece)
        T = a["keyframe.T_c_w"][rows]
        observed = np.split(a["keypoint.anchor"], np.cumsum(a["keyframe.keypoints"])[:-1])
        distance = [
            np.linalg.norm(a["anchor.p_w"][observed[k][observed[k] >= 0]] @ t[:3, :3].T + t[:3, 3], axis=1)
            for k, t in zip(rows, T, strict=True)
        ]
        median_m = scale.value * float(np.median(np.concatenate(distance)))
        if not PLAUSIBLE_M[0] <= median_m <= PLAUSIBLE_M[1]:
            raise Damaged(f"with {scale.value:g} metres a unit its points are {median_m:g} m away")


def _check_anchors(a: dict[str, Array], keyframes: int) -> None:
    observed, count = a["keypoint.anchor"], len(a["anchor.p_w"])
    _require(_within(observed, -1, count), "a keypoint refers to a missing anchor")
    keyframe = np.repeat(np.arange(len(a["keyframe.keypoints"])), a["keyframe.keypoints"])
    pair = (keyframe * max(count, 1) + observed)[observed >= 0]
    _require(len(np.unique(pair)) == len(pair), "a keyframe observes an anchor twice")
    _require(len(np.unique(observed[observed >= 0])) == count, "an anchor has no observation")
    _require(len(np.unique(keyframe[observed >= 0])) == len(a["keyframe.id"]), "a keyframe observes no anchor")
    guessed = a["anchor.from_depth"] != 0
    _require(_within(a["anchor.host"][guessed], 0, keyframes), "a depth prior refers to a missing keyframe")
    _require((a["anchor.prior"][guessed] > 0).all(), "a depth prior is not positive")
    _require((a["anchor.max_distance"] > 0).all(), "an anchor has no distance")
    _require((a["anchor.sigma"] > 0).all() and (a["edge.sigma"] > 0).all(), "a standard deviation is not positive")
    _require((a["edge.p_c"][:, 2] > 0).all(), "an edge is behind its camera")
    for name in ("anchor.visible", "anchor.found", "edge.observations"):
        _require(_within(a[name], 0, 1 << 31), f"{name} is not a count")


def _require(holds: Any, otherwise: str) -> None:
    if not holds:
        raise Damaged(otherwise)


def _within(values: IntArray, low: int, end: int) -> bool:
    return bool(((values >= low) & (values < end)).all())


def _divides(counts: IntArray, total: int) -> bool:
    """Whether counts are non-negative and add up to a total."""
    return _within(counts, 0, total + 1) and int(counts.sum()) == total


def _are_poses(T: FloatArray) -> bool:
    R = T[:, :3, :3]
    rigid = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max(initial=0.0) < 1e-6
    last = np.abs(T[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(initial=0.0) < 1e-9
    return bool(rigid and last and (np.linalg.det(R) > 0).all())
