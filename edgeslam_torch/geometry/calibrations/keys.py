"""Keys of calibration files, and conversion of a record to a camera.

Keys are compared without case, separators and camera prefix (``Camera1.fx``, ``image_width``, ``imageWidth``). Every
key is either used, ignored as irrelevant, rejected because it could be part of a calibration, or listed in a remark.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from edgeslam_torch.errors import CalibrationError
from edgeslam_torch.geometry.calibrations import lens_models
from edgeslam_torch.geometry.calibrations.text import CORNER_ORIGIN
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.types import FloatArray

_NAMES = {
    "width": "width imagewidth imgwidth w cols",
    "height": "height imageheight imgheight h rows",
    "size": "resolution imagesize imgsize size imageresolution",
    "fx": "fx flx focalx focallengthx fu mu gamma1",
    "fy": "fy fly focaly focallengthy fv mv gamma2",
    "f": "f focal focallength",
    "cx": "cx ppx principalx u0 pu principalpointx",
    "cy": "cy ppy principaly v0 pv principalpointy",
    "c": "principalpoint pp",
    "K": "k k1 camk cameramatrix intrinsics intrinsic intrinsicmatrix cameraintrinsics mtx m1 calibration kmatrix "
    "projectionparameters cameraintrinsicmatrix",
    "D": "d d1 distortion distortioncoeffs distortioncoefficients distortioncoefficient distcoeffs distcoeff dist "
    "distcoef distcoefs kc kd distortioncoefs distortionparameters distortionparams distortionvector lensdistortion "
    "coeffs",
    "lens": "model cameramodel distortionmodel modeltype type cameratype lens lensmodel lenstype distortiontype "
    "projection projectionmodel distmodel intrinsicsmodel",
    "fisheye": "fisheye isfisheye fisheyemodel",
    "focal_sigma": "focalsigma",
    "angle": "cameraanglex",
    "omega": "omega fov w0",
    CORNER_ORIGIN: "cornerorigin",
}
_CANONICAL = {alias: name for name, aliases in _NAMES.items() for alias in aliases.split()}
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

_OWN_PREFIXES = frozenset(("camera", "camera0", "camera1", "cam", "cam0", "left"))
"""Prefixes before a dot (``Camera1.fx``) that are stripped."""
_OTHER_CAMERA = re.compile(r"(right|depth|ir|infra\w*|camera[2-9]|cam[1-9])(camera)?")

_HARMLESS = re.compile(
    # ours, calibration programs'
    r"source|comment|notes?|description|name|cameraname|serial(number|no)?|version|fileversion|date|time|unit|depthscale"
    r"|depthmapfactor|calibrationtime|calibrationdate|nr?(of)?frames|board(width|height|size)|square(size)?|flags(value)?"
    r"|fix.*|aspectratio|avg?reprojectionerror|(per|avg)?.*reprojectionerrors?|rms(error)?|extrinsicparameters"
    r"|image(points|list)|gridpoints|imgpoints|objpoints|rvecs|tvecs|error|pattern.*|calibrat(ion)?pattern"
    # ROS
    r"|header|frameid|r|p|p1|rectification(matrix)?|projection(matrix)?|binning[xy]|roi|stamp|seq|rostopic|topic"
    # EuRoC, Kalibr, OpenVINS
    r"|sensortype|tbs|rate(hz)?|hz|fps|camoverlaps|t(bs|cam.*|cn.*|imu.*|i\d?c\d?|c\d.*|b.*)|timeshift.*|lineoffset|linedelay"
    # nerfstudio, instant-ngp
    r"|frames|cameraangley|aabbscale|plyfilepath|appliedtransform|appliedscale|orientationoverride"
    r"|trainfilenames|valfilenames|testfilenames|n?camera(s|id)|filepath|enabledepthloading|integerdepthscale"
    # ORB-SLAM, stella_vslam
    r"|camera(fps|rgb|bf|colororder|newwidth|newheight|lappingbegin|lappingend)|rgb|bf|baseline|colororder|newwidth"
    r"|newheight|lapping(begin|end)|thdepth|setup|thfarpoints|.*tsize|tc1c2|tbc1?"
    # VINS
    r"|imu|imu(topic)?|image.*topic|outputpath|numofcam|(cam\dcalib)|estimate.*|extrinsic.*|bodytcam\d|bodytimu|maxcnt"
    r"|mindist|freq|fthreshold|showtrack|showimage|equalize|flowback|maxsolvertime|maxnumiterations|keyframeparallax"
    r"|acc[nw]|gyr[nw]|gnorm|loopclosure|loadpreviousposegraph|fastrelocalization|posegraphsavepath|td|rollingshutter(tr)?"
    r"|saveimage|visualize.*|multiplethread|usegpu.*|supportfile|configpath"
)
_HARMLESS_GROUPS = re.compile(
    r"(orbextractor|viewer|imu|stereo|rgbd|system|loopclosing|tracking|mapping|preprocessing|feature|pangolin\w*|header"
    r"|stamp|frames|roi|imu\d+|initializer|relocalizer|keyframe\w*|mappublisher|looploader|graphoptimizer|loopdetector)$"
)
"""Groups of settings irrelevant to the lens: ORB-SLAM's, stella_vslam's, ROS's."""
_CALIBRATION_LIKE = re.compile(
    r".*(dist(?!ance)|lens|model|coef|fish|omni|focal|princip|intrin|skew|matrix|mirror|radial|tangent|rational|fov|calib"
    r"|undist|decimat|radtan|brown|plumb|barrel|kappa).*|[kpsfc]\d*[xyuvr]?\d?|xi|alpha|beta|omega|gamma\d?|crop.*|shear"
)


def camera_of(record: dict[str, Any], source: str, size: tuple[int, int] | None) -> tuple[Camera, list[str]]:
    """Camera from a record, and remarks for the user.

    Args:
        record: From `edgeslam_torch.geometry.calibrations.text.record_of`.
        source: Name of the file.
        size: ``(width, height)`` of the images, if the record does not contain it.

    Raises:
        CalibrationError: If it describes no camera, or contains a possible calibration key that is not supported.
    """
    remarks: list[str] = []
    _refuse_parts(record)
    if "cam0_calib" in record:  # VINS-Fusion's settings
        raise CalibrationError(f"the calibration is in another file, {str(record['cam0_calib'])[:60]!r}; give that")
    stated, coefficients, lenses = _sorted(_one_camera(record, remarks), remarks)
    width, height = _size(stated, size, remarks)
    fx, fy, cx, cy, more = _intrinsics(stated, width, height)
    if stated.get(CORNER_ORIGIN):
        cx, cy = cx - 0.5, cy - 0.5
    if not _is_zero(stated.get("fisheye", 0)):
        lenses.append("fisheye")
    family = _family(lenses)
    if "mu" in coefficients:  # camodocal's Kannala-Brandt coefficients start at k2
        coefficients = {f"k{int(k[1]) - 1}": x for k, x in coefficients.items() if k != "mu"}
    D = _coefficients(family, coefficients, [*more, *_distortion(stated)])
    if family == lens_models.FOV and "omega" in stated:
        D = [_number("omega", stated["omega"])]
    elif not _is_zero(stated.get("omega", 0)):
        raise CalibrationError("an angle of view is supported for fov lenses only; state fx and fy")
    if not D and family == lens_models.FISHEYE:
        raise CalibrationError("it states a fisheye lens, and no distortion coefficients; write four, zeros included")
    if not D and family not in (lens_models.PINHOLE, lens_models.NO_LENS):
        remarks.append(f"it states a {family} lens, but no distortion coefficients: taken as none")
    if family == lens_models.FOV:
        magnification = lens_models.fov_magnification(D[0] if D else 0.0)
        fx, fy = fx * magnification, fy * magnification
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    sigma = _number("focal_sigma", stated.get("focal_sigma", 0.0))
    camera = Camera(width, height, fx, fy, cx, cy, source=source, focal_sigma=sigma)  # checks the numbers
    distortion, misfit_px = lens_models.five_numbers(family, D, K, (width, height))
    if misfit_px is not None:
        remarks.append(lens_models.fit_remark(family, misfit_px))
    return replace(camera, distortion=distortion), list(dict.fromkeys(remarks))


def _plain(key: Any) -> str:
    return re.sub(r"[\s_.\-]", "", str(key).lower())


def _one_camera(record: dict[str, Any], remarks: list[str]) -> dict[str, Any]:
    """The first of several cameras (``cam0``, ``cam1``) with the common keys; the record itself if it has only one."""
    cameras = [k for k, v in record.items() if re.fullmatch(r"(?i)(cam|camera)[_-]?\d+", str(k)) and _is_group(v)]
    if len(cameras) > 1:
        remarks.append(f"{len(cameras)} cameras in it, {cameras[0]} is used")
    return {k: v for k, v in record.items() if k not in cameras[1:]}


def _is_group(value: Any) -> bool:
    """Whether it is a mapping of keys and not a matrix with ``data``."""
    return isinstance(value, dict) and "data" not in value


def _flat(record: dict[str, Any], remarks: list[str], group: str = "") -> Iterator[tuple[str, str, Any]]:
    """Key as written, normalised key and value, without ignored groups and other cameras."""
    for key, value in record.items():
        written = f"{group}{key}"
        prefix, _, last = str(key).rpartition(".")
        name = prefix.lower() if prefix else _plain(key) if _is_group(value) else ""
        if _HARMLESS_GROUPS.fullmatch(name) or (_is_group(value) and _HARMLESS.fullmatch(_plain(key))):
            continue
        if _OTHER_CAMERA.fullmatch(name) and not (name.startswith("cam") and not prefix):
            remarks.append(f"{prefix or key} is another camera and is not used")
        elif _is_group(value):
            yield from _flat(value, remarks, f"{written}.")
        else:
            yield written, _plain(last if name in _OWN_PREFIXES or not prefix else key), value


def _sorted(record: dict[str, Any], remarks: list[str]) -> tuple[dict[str, Any], dict[str, float], list[str]]:
    """Values by canonical name, coefficients by name, and names of lens models.

    Raises:
        CalibrationError: If a possible calibration key is not supported, or contradicts another.
    """
    stated: dict[str, Any] = {}
    coefficients: dict[str, float] = {}
    lenses: list[str] = []
    unused: list[str] = []
    for written, plain, value in _flat(record, remarks):
        name = _CANONICAL.get(plain)
        if value in (None, "", []):
            if name == "D":
                stated.setdefault("D", [])
        elif plain in _COEFFICIENTS and not _is_list(value):
            _put(coefficients, plain, _number(written, value), written)
        elif name == "lens":
            if not isinstance(value, str):
                raise CalibrationError(f"{written}: a lens model is a name, got {value!r:.60}")
            lenses.append(value)
        elif name is not None:
            _put(stated, name, value, written)
            if plain == "mu":
                coefficients["mu"] = 0.0
        elif _HARMLESS.fullmatch(plain):
            continue
        elif isinstance(value, str) and lens_models.is_distorting(value):
            lenses.append(value)
        elif _CALIBRATION_LIKE.fullmatch(plain) and not _is_zero(value):
            raise CalibrationError(f"{written!r:.80} is not understood and could be part of the calibration")
        else:
            unused.append(written)
    if unused:
        more = f" and {len(unused) - 5} more" if len(unused) > 5 else ""
        remarks.append(f"not used: {', '.join(key[:40] for key in unused[:5])}{more}")
    return stated, coefficients, lenses


def _put(into: dict[str, Any], name: str, value: Any, written: str) -> None:
    if name in into and into[name] != value and _flat_numbers(written, into[name]) != _flat_numbers(written, value):
        raise CalibrationError(f"{written!r:.80} contradicts another key of the same meaning; keep one")
    into[name] = value


def _refuse_parts(record: dict[str, Any]) -> None:
    """Reject calibrations of a part of the image: ROS's binning and region of interest."""
    roi = record.get("roi")
    cut = isinstance(roi, dict) and any(roi.get(k) for k in ("x_offset", "y_offset"))
    if isinstance(roi, dict) and not cut:
        cut = any(roi.get(k) not in (None, 0, record.get(k)) for k in ("width", "height"))
    if cut or any(record.get(k) not in (None, 0, 1) for k in ("binning_x", "binning_y")):
        raise CalibrationError("calibration of a part of the image (roi, binning)")


def _is_zero(value: Any) -> bool:
    """Whether a value is false or zero, also as text."""
    return str(value).strip().lower() in ("0", "0.0", "0.", "false", "no", "off")


def _is_list(value: Any) -> bool:
    return isinstance(value, list | tuple | dict)


def _number(key: str, value: Any) -> float:
    """A finite number, also from text such as ``1e-5``, which YAML parses as a string.

    Raises:
        CalibrationError: If it is not a finite number.
    """
    try:
        if isinstance(value, bool) or not isinstance(value, int | float | str):
            raise ValueError
        number = float(value)
    except (ValueError, OverflowError) as error:
        raise CalibrationError(f"{key} must be a number, got {value!r:.60}") from error
    if not math.isfinite(number):
        raise CalibrationError(f"{key} is not finite: {value!r:.60}")
    return number


def _flat_numbers(key: str, value: Any) -> list[float]:
    """Numbers of a list, a matrix of any nesting, ``{rows, cols, data}``, or a list written as text."""
    if isinstance(value, dict):
        data = _flat_numbers(key, value.get("data"))
        shape = [int(_number(key, value[side])) for side in ("rows", "cols") if side in value]
        if len(shape) == 2 and shape[0] * shape[1] != len(data):
            raise CalibrationError(f"{key} states {shape[0]} x {shape[1]} numbers and has {len(data)}")
        return data
    if isinstance(value, str):
        value = re.split(r"[\s,;]+", re.sub(r"[\[\](){}]", " ", value).strip())
        value = [] if value == [""] else value
    if isinstance(value, list | tuple):
        return [x for item in value for x in (_flat_numbers(key, item) if _is_list(item) else [_number(key, item)])]
    return [_number(key, value)]


def _size(stated: dict[str, Any], images: tuple[int, int] | None, remarks: list[str]) -> tuple[int, int]:
    if "size" in stated:
        both = _flat_numbers("image size", stated["size"])
        if len(both) != 2:
            raise CalibrationError(f"an image size is width and height, got {len(both)} numbers")
        for name, value in zip(("width", "height"), both, strict=True):
            _put(stated, name, value, "resolution")
    sides = [_number(name, stated[name]) for name in ("width", "height") if name in stated]
    if not sides:
        if images is None:
            raise CalibrationError("it states no image size; add width and height")
        remarks.append(f"it states no image size: taken as made for these {images[0]}x{images[1]} images")
        return images
    if len(sides) != 2 or any(side != int(side) for side in sides):
        raise CalibrationError("an image size is a whole width and a whole height")
    return int(sides[0]), int(sides[1])


def _intrinsics(stated: dict[str, Any], width: int, height: int) -> tuple[float, float, float, float, list[float]]:
    """fx, fy, cx, cy, and coefficients that follow them in one list."""
    more: list[float] = []
    if "K" in stated:
        numbers = _flat_numbers("K", stated["K"])
        if _looks_like_matrix(numbers):
            fx, fy, cx, cy = _of_matrix(np.reshape(numbers, (3, 3)))
        elif len(numbers) >= 4:
            (fx, fy, cx, cy), more = numbers[:4], numbers[4:]
        else:
            raise CalibrationError(f"{len(numbers)} intrinsics; they are fx fy cx cy or a matrix of 3 x 3")
        for name, value in zip(("fx", "fy", "cx", "cy"), (fx, fy, cx, cy), strict=True):
            _put(stated, name, value, name)
    if "f" in stated:
        both = _flat_numbers("f", stated["f"])
        for name, value in zip(("fx", "fy"), both * 2 if len(both) == 1 else both, strict=False):
            _put(stated, name, value, name)
    if "c" in stated:
        for name, value in zip(("cx", "cy"), _flat_numbers("principal point", stated["c"]), strict=False):
            _put(stated, name, value, name)
    if "angle" in stated and "fx" not in stated:  # NeRF's horizontal field of view
        stated["fx"] = 0.5 * width / math.tan(0.5 * _number("camera_angle_x", stated["angle"]))
        stated.setdefault("fy", stated["fx"])
        corner = 0.5 if stated.get(CORNER_ORIGIN) else 0.0
        stated.setdefault("cx", 0.5 * (width - 1) + corner)
        stated.setdefault("cy", 0.5 * (height - 1) + corner)
    missing = [name for name in ("fx", "fy", "cx", "cy") if name not in stated]
    if missing:
        raise CalibrationError(f"it does not state {', '.join(missing)}; it needs width, height, fx, fy, cx, cy")
    fx, fy, cx, cy = (_number(name, stated[name]) for name in ("fx", "fy", "cx", "cy"))
    return fx, fy, cx, cy, more


def _looks_like_matrix(numbers: list[float]) -> bool:
    return len(numbers) == 9 and numbers[8] == 1.0 and numbers[1] == numbers[3] == 0.0


def _of_matrix(K: FloatArray) -> tuple[float, float, float, float]:
    if K[2, 0] and not K[0, 2]:
        K = K.T  # Open3D is column-major
    if K[0, 1] or K[1, 0] or K[2, 0] or K[2, 1]:
        raise CalibrationError("a matrix with skew is not supported")
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _family(lenses: list[str]) -> str:
    """The lens model among all names; a projection (pinhole) does not specify the distortion."""
    families = {lens_models.family_of(lens) for lens in lenses} - {lens_models.PINHOLE}
    if len(families) > 1:
        raise CalibrationError(f"it names two lens models, {' and '.join(repr(lens) for lens in sorted(lenses))}")
    return families.pop() if families else lens_models.PINHOLE


def _distortion(stated: dict[str, Any]) -> list[float]:
    return _flat_numbers("distortion", stated["D"]) if "D" in stated else []


def _coefficients(family: str, named: dict[str, float], listed: list[float]) -> list[float]:
    """Coefficients in the model's own order, from a list or from ``k1 ... p2``."""
    if not named:
        return listed
    fisheye = family == lens_models.FISHEYE
    order = ["k1", "k2", "k3", "k4"] if fisheye else ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
    extra = [key for key, value in named.items() if key not in order and value]
    if extra or (family == lens_models.FOV and any(named.values())):
        raise CalibrationError(f"{', '.join(extra or named)}: no coefficient of a {family} lens")
    if "k1" not in named and any(named.values()):
        raise CalibrationError("distortion coefficients without k1")
    values = [named.get(key, 0.0) for key in order]
    if not fisheye and not any(values[5:]):
        values = values[:5]
    width = max(len(values), len(listed))
    if listed and [*listed, *[0.0] * (width - len(listed))] != [*values, *[0.0] * (width - len(values))]:
        raise CalibrationError("it states the distortion twice, and differently")
    return [] if family == lens_models.FOV else values
