"""Write calibration files; read those of this and other programs."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.plain import open_plain
from edgeslam_torch.geometry.calibrations.keys import camera_of
from edgeslam_torch.geometry.calibrations.text import MAX_JSON_BYTES, record_of
from edgeslam_torch.geometry.camera import PRESETS, Camera
from edgeslam_torch.geometry.lens import check_camera


def save_camera(path: Path, camera: Camera) -> None:
    """Write ``camera.yaml``."""
    record = {
        "model": "pinhole",
        "width": camera.width,
        "height": camera.height,
        "fx": float(camera.fx),
        "fy": float(camera.fy),
        "cx": float(camera.cx),
        "cy": float(camera.cy),
        "distortion": [float(k) for k in camera.distortion],
        "source": camera.source,
        "focal_sigma": float(camera.focal_sigma),
    }
    write_text(Path(path), yaml.safe_dump(record, sort_keys=False))


def load_camera(name: str | Path) -> Camera:
    """`read_camera` without the remarks, for a file that contains the image size."""
    return read_camera(name)[0]


def read_camera(name: str | Path, size: tuple[int, int] | None = None) -> tuple[Camera, list[str]]:
    """Camera from a preset's name or a calibration file, and remarks for the user.

    Reads our ``camera.yaml`` and the files of Kalibr, ROS, EuRoC, OpenCV (YAML, XML), ORB-SLAM, VINS, COLMAP, DSO,
    DPVO, MASt3R-SLAM and nerfstudio; `edgeslam_torch.geometry.calibrations.keys` maps their keys.

    Args:
        name: Preset or file.
        size: ``(width, height)`` of the images, for files without it.

    Raises:
        CalibrationError: If there is neither such a preset nor such a file, the file is malformed or has unsupported
            content, or its numbers are implausible.
    """
    if str(name) in PRESETS:
        return replace(PRESETS[str(name)], source=f"preset {name}"), []
    path = Path(name)
    if not path.is_file():
        raise CalibrationError(f"no camera file or preset {str(name)!r}; presets: {', '.join(PRESETS)}")
    with _named(path):
        record, remarks = _record(path)
        camera, more = camera_of(record, str(Path(*path.parts[-2:])), size)
        check_camera(camera)
    return camera, [f"{path}: {remark}" for remark in [*remarks, *more]]


def camera_keys(path: Path) -> dict[str, Any]:
    """Keys and values of a calibration file in any of the formats, as written.

    Raises:
        CalibrationError: If it is malformed.
    """
    with _named(path):
        return _record(path)[0]


def _record(path: Path) -> tuple[dict[str, Any], list[str]]:
    size = path.stat().st_size
    if size > MAX_JSON_BYTES:
        raise ValueError(f"{size / 1e6:.0f} MB is too large")
    with open_plain(path) as file:
        return record_of(file.read())


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Convert every error of a file's content to one line with its name."""
    try:
        yield
    except OSError as error:
        raise CalibrationError(f"{path}: {error.strerror or error}") from error
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
    except RecursionError as error:
        raise CalibrationError(f"{path}: not a camera calibration, nested too deeply") from error
    except (KeyError, TypeError, ValueError, IndexError, OverflowError, AttributeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise CalibrationError(
            f"{path}: not a camera calibration ({reason}); it needs width, height, fx, fy, cx, cy"
        ) from error
