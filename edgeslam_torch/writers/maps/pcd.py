"""Point clouds as binary PCD 0.7, the format of the Point Cloud Library: ``x y z rgb sigma observations``."""

from pathlib import Path

import numpy as np

from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.types import PointCloud

POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<f4"), ("sigma", "<f4"), ("observations", "<i4")])
"""``rgb`` is 0x00RRGGBB in the bits of a float, as in PCL."""


def write_pcd(path: Path, cloud: PointCloud, comment: str = "") -> None:
    """Write a cloud, atomically, with a comment in its header."""
    points = np.empty(len(cloud.p_w), dtype=POINT)
    for axis, name in enumerate(("x", "y", "z")):
        points[name] = cloud.p_w[:, axis]
    red, green, blue = (cloud.colour[:, k].astype(np.uint32) for k in range(3))
    points["rgb"] = (red << 16 | green << 8 | blue).view(np.float32)
    points["sigma"], points["observations"] = cloud.sigma_m, cloud.observations
    names = POINT.names or ()
    header = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *([f"# {comment}"] if comment else []),
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
    data = "\n".join(header).encode("ascii", errors="replace") + points.tobytes()
    write_atomically(path, lambda file: file.write(data))
