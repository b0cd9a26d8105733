"""Choice of the calibration for a source, with warnings when there is none."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.camera import GUESSED_FOCAL_SIGMA, PRESETS, Camera
from edgeslam_torch.geometry.camera_file import load_camera, read_camera
from edgeslam_torch.geometry.lens import unique_share

CALIBRATION_FILES = (
    *("camera.yaml", "ost.yaml", "sensor.yaml", "camera.yml", "camera.xml", "camera.json", "camera.txt"),
    *("camera_info.yaml", "camchain.yaml", "calibration.yaml", "calibration.yml", "intrinsics.yaml", "cameras.txt"),
    "transforms.json",
)
"""Names of calibrations beside images: ours, ROS's, EuRoC's, and those of the formats that are read."""
_ASPECT_TOLERANCE = 0.005
"""Relative; KITTI's 1241x376 halved is off by 0.001, 4:3 and 16:9 differ by 0.33."""

_PLAIN_SCALES = (2.0, 0.5, 3.0, 1.0 / 3.0, 1.5, 2.0 / 3.0, 4.0, 0.25)
"""Ratios of the size that a calibration was made for to the images'; a principal point at the centre of such a size
is evidence for it."""
_SCALE_TOLERANCE = 0.2
"""Relative to the difference from 1; principal points of real cameras lie within a tenth of the middle (EuRoC's cam0:
0.04)."""
_MAX_OFF_MIDDLE = 0.5
"""Relative to half the width or height."""
_MAX_PIXEL_ASPECT = 1.1
"""Maximum ratio of the focal lengths without a warning; digitised PAL video has 1.07, anamorphic video 1.33."""

TELLO_SIZES = ((960, 720), (648, 478))
"""Resolutions of its video, high and low."""
_TELLO_FOCAL_SIGMA = 0.01
"""Five measured drones lie within 1 % of their median."""

GUESS = "guess"
"""Prefix of the ``source`` of a guessed camera."""
GUESS_WARNING = "no calibration found: guessing"
GUESS_COST = (
    "a focal length error of 10 % bends the trajectory and changes its scale by about as much; "
    "give --camera FILE (make one with: edgeslam calibrate)"
)


def choose_camera(
    size: tuple[int, int],
    given: str | Path | None = None,
    folders: Sequence[Path] = (),
    default: Camera | None = None,
    is_drone: bool = False,
    own: Camera | None = None,
) -> tuple[Camera, list[str]]:
    """Calibration for images of one size; the paper's ``E = K^T F K`` needs K and cannot provide it.

    In this order: the given one, the recording's own, a calibration file beside it, the data set's default, the
    Tello's if the source looks like one, a guess. A focal length from F may replace a guess later.

    Args:
        size: ``(width, height)`` of the images [px].
        given: File or preset from ``--camera``.
        folders: Where to look for `CALIBRATION_FILES`, in this order.
        default: Of the data set.
        is_drone: Whether there is telemetry.
        own: Calibration inside the recording.

    Returns:
        The camera, with its origin in ``source`` and its uncertainty in ``focal_sigma``, and warnings in words.

    Raises:
        CalibrationError: If the calibration is malformed or made for images of another shape.
    """
    if own is not None and given is None:
        camera, notes = fitted(own, size, own.source)
        return camera, [*notes, *_doubts(camera, own.source)]
    found = given if given is not None else _calibration_in(folders)
    if found is not None:
        camera, remarks = read_camera(found, size)
        camera, notes = fitted(camera, size, str(found))
        return camera, [*remarks, *notes, *_doubts(camera, str(found))]
    if default is not None:
        camera, notes = fitted(default, size, default.source)
        return camera, [*notes, f"no calibration found: using {camera.source}; give --camera FILE for yours"]
    if is_drone and size in TELLO_SIZES:
        source = "default for a Tello (median of five drones)"
        camera = replace(_tello(size), source=source, focal_sigma=_TELLO_FOCAL_SIGMA)
        note = f"no calibration found: using the {camera.source}; yours may differ by 1 % in focal length"
        return camera, [note]
    focal = 1.2 * max(size)
    centre = ((size[0] - 1) / 2.0, (size[1] - 1) / 2.0)
    source = f"{GUESS}: 1.2*max(w,h) = {focal:.0f} px"
    camera = Camera(*size, focal, focal, *centre, source=source, focal_sigma=GUESSED_FOCAL_SIGMA)
    warnings = [f"{GUESS_WARNING} a focal length of {focal:.0f} px; {GUESS_COST}"]
    if size[0] == 2 * size[1]:
        warnings.append("pictures twice as wide as high: a panorama has no focal length; export a flat video")
    return camera, warnings


def _tello(size: tuple[int, int]) -> Camera:
    """The Tello's lens at another resolution: same width of view, square pixels, same middle row."""
    tello = PRESETS["tello"]
    scale = size[0] / tello.width
    whole = tello.scaled(size[0], round(tello.height * scale))
    return replace(whole, height=size[1], fy=whole.fx, cy=whole.cy + 0.5 * (size[1] - whole.height))


def _doubts(camera: Camera, name: str) -> list[str]:
    """Warnings about a calibration that is possible and unlikely."""
    doubts = []
    share = unique_share(camera)
    if share < 1.0:
        doubts.append(
            f"{name}: its distortion turns back at {100 * share:.0f} % of the way to the border, pixels beyond are "
            "misplaced; calibrate with pictures in which the board reaches the corners"
        )
    if not 1.0 / _MAX_PIXEL_ASPECT <= camera.fx / camera.fy <= _MAX_PIXEL_ASPECT:
        doubts.append(
            f"{name}: fx is {camera.fx / camera.fy:.2f} times fy, pixels of nearly all cameras are square; a mistyped "
            "number, or images stretched after the calibration?"
        )
    ratios = [2.0 * (camera.cx + 0.5) / camera.width, 2.0 * (camera.cy + 0.5) / camera.height]
    for plain in _PLAIN_SCALES:
        if all(abs(ratio - plain) < _SCALE_TOLERANCE * abs(plain - 1.0) for ratio in ratios):
            made_for = f"{round(plain * camera.width)}x{round(plain * camera.height)}"
            raise CalibrationError(
                f"{name}: the principal point ({camera.cx:g}, {camera.cy:g}) lies in the middle of {made_for} images, "
                f"these are {camera.width}x{camera.height}; if it was made for those, state width and height "
                f"{made_for} in it and it is scaled"
            )
    if any(abs(ratio - 1.0) > _MAX_OFF_MIDDLE for ratio in ratios):
        doubts.append(
            f"{name}: the principal point ({camera.cx:g}, {camera.cy:g}) is more than a quarter off the middle of "
            f"{camera.width}x{camera.height} images; is it the calibration of other images, or of a crop?"
        )
    return doubts


def fitted(camera: Camera, size: tuple[int, int], name: str) -> tuple[Camera, list[str]]:
    """The calibration for images of ``size``, scaled when only the resolution differs.

    Raises:
        CalibrationError: If the aspect ratio differs: the crop is unknown.
    """
    if (camera.width, camera.height) == size:
        return camera, []
    made_for, are = f"{camera.width}x{camera.height}", f"{size[0]}x{size[1]}"
    if not math.isclose(camera.width * size[1], camera.height * size[0], rel_tol=_ASPECT_TOLERANCE):
        raise CalibrationError(
            f"{name}: made for {made_for} images, these are {are}, another shape; "
            f"calibrate at {are} or give another --camera"
        )
    source = f"{camera.source}, scaled from {made_for} to {are}"
    note = f"{name}: made for {made_for} images, scaled to {are}"
    return replace(camera.scaled(*size), source=source), [note]


def known_camera(folders: Sequence[Path], default: Camera | None = None) -> Camera | None:
    """Calibration that a recording has: a file in one of its folders, else its data set's own; None without either.

    Raises:
        CalibrationError: If the file is malformed.
    """
    found = _calibration_in(folders)
    return default if found is None else load_camera(found)


def _calibration_in(folders: Sequence[Path]) -> Path | None:
    candidates = (folder / name for folder in folders for name in CALIBRATION_FILES)
    return next((path for path in candidates if path.is_file()), None)
