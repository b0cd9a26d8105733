"""Calibration of a ``CameraInfo`` message."""

from typing import Any

import numpy as np

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.calibrations.lens_models import NO_LENS, PINHOLE, family_of, fit_remark, five_numbers
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.lens import check_camera


def camera_from_info(info: Any, name: str, rectified: bool) -> tuple[Camera | None, list[str]]:
    """Camera of the pictures, None if the driver sent an empty calibration; and remarks.

    Args:
        info: ``sensor_msgs/CameraInfo`` of either version of ROS.
        name: File and topic, for messages.
        rectified: Whether the pictures are rectified, so that the projection ``P`` applies and no distortion.

    Raises:
        CalibrationError: If it describes no camera, a part of an image, or a lens that our model cannot express.
    """
    K = np.asarray(info.k if hasattr(info, "k") else info.K, dtype=np.float64).reshape(3, 3)
    P = np.asarray(info.p if hasattr(info, "p") else info.P, dtype=np.float64).reshape(3, 4)
    D = [float(x) for x in (info.d if hasattr(info, "d") else info.D)]
    lens = str(info.distortion_model)
    if rectified and P[0, 0] > 0:
        K, D, lens = P[:, :3], [], NO_LENS
    if K[0, 0] == 0:
        return None, []
    if _is_part(info):
        raise CalibrationError(f"{name}: calibration of a part of the image (roi, binning); give --camera FILE")
    size = (int(info.width), int(info.height))
    K_numbers = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    try:
        distortion, misfit_px = five_numbers(family_of(lens) if lens else PINHOLE, D, K, size)
        camera = Camera(*size, *K_numbers, distortion, source=name)
        check_camera(camera)
    except CalibrationError as error:
        raise CalibrationError(f"{name}: {error}; give --camera FILE") from error
    return camera, [] if misfit_px is None else [f"{name}: {fit_remark(lens, misfit_px)}"]


def _is_part(info: Any) -> bool:
    roi = info.roi
    cut = roi.x_offset or roi.y_offset or (roi.width not in (0, info.width)) or (roi.height not in (0, info.height))
    return bool(cut) or info.binning_x > 1 or info.binning_y > 1
