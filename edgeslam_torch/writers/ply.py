"""Point clouds as binary PLY: ``x y z red green blue sigma observations``."""

import re
from pathlib import Path
from typing import BinaryIO

import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.files.plain import open_plain
from edgeslam_torch.types import FloatArray, PointCloud

VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("sigma", "<f4"),
        ("observations", "<i4"),
    ]
)
"""One point of the file; ``sigma`` in metres, or map units while the scale is unknown."""

NORMAL = ("nx", "ny", "nz")

_PLY_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    **{np.dtype(kind).name: kind for kind in ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8")},
}
"""The format's own names, and those of newer programs: ``float32``."""
_NAMES = {"f4": "float", "u1": "uchar", "i4": "int"}
_MAX_HEADER_BYTES = 65536


def write_ply(path: Path, cloud: PointCloud, comments: tuple[str, ...] = (), normals: FloatArray | None = None) -> None:
    """Write a cloud, atomically; extra properties such as ``sigma`` are ignored by other viewers.

    Args:
        path: File to make.
        cloud: ``P`` points.
        comments: Lines for the header, such as the units.
        normals: ``(P, 3)`` for ``nx ny nz``; none by default.
    """
    dtype = VERTEX if normals is None else np.dtype([*VERTEX.descr, *((name, "<f4") for name in NORMAL)])
    vertices = np.empty(len(cloud.p_w), dtype=dtype)
    for axis, name in enumerate(("x", "y", "z")):
        vertices[name] = cloud.p_w[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        vertices[name] = cloud.colour[:, channel]
    vertices["sigma"] = cloud.sigma_m
    vertices["observations"] = cloud.observations
    for axis, name in enumerate(NORMAL if normals is not None else ()):
        vertices[name] = np.asarray(normals)[:, axis]
    properties = [f"property {_NAMES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    remarks = [f"comment {' '.join(comment.split())}" for comment in comments]
    lines = ["ply", "format binary_little_endian 1.0", *remarks, f"element vertex {len(vertices)}", *properties]
    header = "\n".join([*lines, "end_header", ""]).encode("ascii", errors="replace")

    def write(file: BinaryIO) -> None:
        file.write(header)
        file.write(vertices.tobytes())

    write_atomically(path, write)


def read_ply(path: Path) -> PointCloud:
    """Read a cloud written by `write_ply`, or any little-endian or ASCII PLY with points.

    Defaults for missing properties: grey, infinite sigma, one observation.

    Raises:
        SourceError: If the file is missing, no PLY, of an unsupported kind or cut off.
    """
    try:
        with open_plain(path) as file:
            kind, count, dtype = _read_header(file, path)
            body = file.read()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from error
    if kind == "ascii":
        vertices = _ascii_vertices(body, count, dtype, path)
    else:
        if len(body) < count * dtype.itemsize:
            have = len(body) // max(1, dtype.itemsize)
            raise SourceError(f"{path}: cut off after {have} of {count} points; make it again")
        vertices = np.frombuffer(body, dtype=dtype, count=count)
    return _cloud(vertices, path)


def _read_header(file: BinaryIO, path: Path) -> tuple[str, int, np.dtype]:
    if file.readline(_MAX_HEADER_BYTES).strip() != b"ply":
        raise SourceError(f"{path}: not a PLY file")
    kind, count, element, size = "", 0, "", 0
    fields: list[tuple[str, str]] = []
    while size < _MAX_HEADER_BYTES:
        line = file.readline(_MAX_HEADER_BYTES)
        size += len(line)
        words = line.decode("ascii", errors="replace").split()
        if words == ["end_header"]:
            if kind not in ("ascii", "binary_little_endian"):
                raise SourceError(f"{path}: PLY format {kind or 'missing'}; binary_little_endian and ascii are read")
            if len({name for name, _ in fields}) < len(fields):
                raise SourceError(f"{path}: its PLY header names a property twice")
            return kind, count, np.dtype(fields)
        if words[:1] == ["format"] and len(words) > 1:
            kind = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and re.fullmatch("[0-9]{1,18}", words[2]):
            if not element and words[1] != "vertex":
                raise SourceError(f"{path}: its first element is {words[1]!r}, points (vertex) must come first")
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _PLY_TYPES:
                raise SourceError(f"{path}: cannot read the property {' '.join(words[1:])!r}")
            fields.append((words[2], "<" + _PLY_TYPES[words[1]]))
        elif not line:
            break
    raise SourceError(f"{path}: its PLY header has no end")


def _ascii_vertices(body: bytes, count: int, dtype: np.dtype, path: Path) -> np.ndarray:
    lines = body.decode("ascii", errors="replace").splitlines()[:count]
    if len(lines) < count:
        raise SourceError(f"{path}: cut off after {len(lines)} of {count} points; make it again")
    names = dtype.names or ()
    try:
        table = np.array([line.split()[: len(names)] for line in lines], dtype=np.float64).reshape(count, len(names))
    except ValueError as error:
        raise SourceError(f"{path}: malformed point ({error})") from error
    vertices = np.empty(count, dtype=dtype)
    for column, name in enumerate(names):
        vertices[name] = table[:, column]
    return vertices


def _cloud(vertices: np.ndarray, path: Path) -> PointCloud:
    names = vertices.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise SourceError(f"{path}: its points have no x, y, z")
    count = len(vertices)
    has_colour = {"red", "green", "blue"} <= set(names)
    grey = np.full((count, 3), 128, dtype=np.uint8)
    return PointCloud(
        p_w=np.stack([vertices[n].astype(np.float32) for n in ("x", "y", "z")], axis=1),
        colour=np.stack([vertices[n].astype(np.uint8) for n in ("red", "green", "blue")], axis=1)
        if has_colour
        else grey,
        sigma_m=vertices["sigma"].astype(np.float32) if "sigma" in names else np.full(count, np.inf, dtype=np.float32),
        observations=vertices["observations"].astype(np.int32) if "observations" in names else np.ones(count, np.int32),
    )
