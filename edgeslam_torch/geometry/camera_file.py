"""Calibration files: ours, ROS's and EuRoC's."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.files.record_files import plain_yaml
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
    Path(path).write_text(yaml.safe_dump(record, sort_keys=False))


def load_camera(name: str | Path) -> Camera:
    """Camera from a preset's name or a calibration file.

    Reads our ``camera.yaml``, ROS ``ost.yaml`` (``camera_matrix`` / ``distortion_coefficients``) and EuRoC
    ``sensor.yaml`` (``intrinsics``).

    Raises:
        CalibrationError: If there is neither such a preset nor such a file, the file is malformed, or its numbers
            cannot be a camera's.
    """
    if str(name) in PRESETS:
        return replace(PRESETS[str(name)], source=f"preset {name}")
    path = Path(name)
    if not path.is_file():
        raise CalibrationError(f"no camera file or preset {str(name)!r}; presets: {', '.join(PRESETS)}")
    try:
        record = plain_yaml(path.read_text(encoding="utf-8"))
        if not isinstance(record, dict):
            raise ValueError("no key: value lines in it")
        camera = _camera_from_record(record, str(Path(*path.parts[-2:])))
        check_camera(camera)
        return camera
    except OSError as error:
        raise CalibrationError(f"{path}: {error.strerror or error}") from error
    except CalibrationError as error:
        raise CalibrationError(f"{path}: {error}") from error
    except RecursionError as error:
        raise CalibrationError(f"{path}: not a camera calibration, nested too deeply") from error
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        reason = " ".join(str(error).split())[:200]
        raise CalibrationError(
            f"{path}: not a camera calibration ({type(error).__name__}: {reason}); "
            "it needs width, height, fx, fy, cx, cy"
        ) from error


def _camera_from_record(record: dict[str, Any], source: str) -> Camera:
    lens = record.get("distortion_model") or "plumb_bob"
    if not isinstance(lens, str) or lens.lower() not in ("plumb_bob", "radial-tangential", "radtan", "none"):
        raise ValueError(f"distortion model {lens!r} is not supported, only plumb_bob (radial-tangential)")
    if "camera_matrix" in record:  # ROS camera_calibration
        k = [float(x) for x in record["camera_matrix"]["data"]]
        d = [float(x) for x in record["distortion_coefficients"]["data"]]
        size = (int(record["image_width"]), int(record["image_height"]))
        return Camera(*size, k[0], k[4], k[2], k[5], _five(d), source)
    if "intrinsics" in record:  # EuRoC sensor.yaml
        fx, fy, cx, cy = (float(x) for x in record["intrinsics"])
        width, height = (int(x) for x in record["resolution"])
        return Camera(width, height, fx, fy, cx, cy, _five(record.get("distortion_coefficients", [])), source)
    model = record.get("model", "pinhole")
    if model != "pinhole":
        raise ValueError(f"camera model {model!r} is not supported, only pinhole")
    fx, fy, cx, cy = (float(record[key]) for key in ("fx", "fy", "cx", "cy"))
    size = (int(record["width"]), int(record["height"]))
    focal_sigma = float(record.get("focal_sigma", 0.0))
    return Camera(*size, fx, fy, cx, cy, _five(record.get("distortion", [])), source, focal_sigma)


def _five(coefficients: list[float]) -> tuple[float, ...]:
    if len(coefficients) > 5:
        raise ValueError(f"{len(coefficients)} distortion coefficients; k1 k2 p1 p2 k3 are supported")
    return tuple(float(k) for k in (*coefficients, *([0.0] * (5 - len(coefficients)))))
