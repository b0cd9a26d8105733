"""Point clouds as binary PCD 0.7, the format of the Point Cloud Library: ``x y z rgb sigma observations``."""

from pathlib import Path

import numpy as np

from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.types import PointCloud

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<f4"), ("sigma", "<f4"), ("observations", "<i4")])
"""``rgb`` is 0x00RRGGBB in the bits of a float, as in PCL."""


def write_pcd(path: Path, cloud: PointCloud) -> None:
    """Write a cloud, atomically.

    Raises:
        OSError: If the file cannot be written.
    """
    points = np.empty(len(cloud.p_w), dtype=POINT)
    for axis, name in enumerate(("x", "y", "z")):
        points[name] = cloud.p_w[:, axis]
    red, green, blue = (cloud.colour[:, k].astype(np.uint32) for k in range(3))
    points["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    points["sigma"], points["observations"] = cloud.sigma_m, cloud.observations
    names = POINT.names or ()
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        "VERSION 0.7",
        "FIELDS " + " ".join(names),
        "SIZE " + " ".join("4" for _ in names),
        "TYPE " + " ".join("I" if POINT[name].kind == "i" else "F" for name in names),
        "COUNT " + " ".join("1" for _ in names),
        f"WIDTH {len(points)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(points)}",
        "DATA binary",
        "",
    ]
    data = "\n".join(header).encode("ascii") + points.tobytes()
    write_atomically(path, lambda file: file.write(data))


def read_pcd(path: Path) -> PointCloud:
    """Read a cloud written by `write_pcd`.

    Raises:
        SourceError: If the file is missing, of another layout or cut off.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from error
    head, mark, body = data.partition(b"DATA binary\n")
    words = {line.split()[0]: line.split()[1:] for line in head.decode("ascii", "replace").splitlines() if line.split()}
    if not mark or words.get("FIELDS") != list(POINT.names or ()) or not words.get("POINTS", [""])[0].isdecimal():
        raise SourceError(f"{path}: not a PCD file of this program (binary, {' '.join(POINT.names or ())})")
    count = int(words["POINTS"][0])
    if len(body) < count * POINT.itemsize:
        raise SourceError(f"{path}: cut off after {len(body) // POINT.itemsize} of {count} points; make it again")
    points = np.frombuffer(body, dtype=POINT, count=count)
    bits = points["rgb"].copy().view(np.uint32)
    colour = np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8)
    p_w = np.stack([points[n] for n in ("x", "y", "z")], axis=1)
    return PointCloud(p_w, colour, points["sigma"].copy(), points["observations"].copy())
