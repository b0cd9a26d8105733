"""A map as LAS 1.4, for surveying programs (``las`` extra)."""

from pathlib import Path

import numpy as np

from edgeslam_torch.extras import needs_extra
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.types import PointCloud

_STEP_M = 1e-4
"""LAS stores whole steps; a tenth of a millimetre is below any sigma of a map."""


def write_las(path: Path, cloud: PointCloud, comment: str = "") -> None:
    """Write a cloud, atomically, with colour, ``sigma`` and ``observations`` as extra dimensions, and a comment as the
    text area description.

    Raises:
        MissingPackageError: If laspy is not installed.
        OSError: If the file cannot be written.
    """
    with needs_extra("las", "LAS"):
        import laspy

    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, _STEP_M), np.floor(cloud.p_w.min(axis=0).astype(np.float64))
    header.add_extra_dims([laspy.ExtraBytesParams("sigma", "f4"), laspy.ExtraBytesParams("observations", "i4")])
    if comment:  # user LASF_Spec, record 3: text area description
        header.vlrs.append(laspy.VLR("LASF_Spec", 3, "z axis", comment.encode("ascii", errors="replace") + b"\0"))
    file = laspy.LasData(header)
    file.xyz = cloud.p_w.astype(np.float64)
    file.red, file.green, file.blue = (cloud.colour.astype(np.uint16) * 257).T
    file.sigma, file.observations = cloud.sigma_m, cloud.observations
    write_atomically(path, lambda target: file.write(target, do_compress=path.suffix.lower() == ".laz"))
