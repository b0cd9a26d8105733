"""Depth maps against measured depth: the figures of Eigen et al. 2014, metric and median-scaled, and at edges alone."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.associate import DEFAULT_MAX_DT_S, nearest
from edgeslam_torch.eval.inputs.dataset import open_depth
from edgeslam_torch.readers.images import pixels_or_none
from edgeslam_torch.types import FloatArray

MIN_DEPTH_M = 1e-3
"""Lower bound of predictions: log and ratio need a positive depth."""
_MAPS, _PICTURES = (".png", ".npy"), (".png", ".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class DepthScore:
    """Errors over the measured pixels of one or more depth maps."""

    pixels: int
    abs_rel: float
    """Mean of ``|d - d*| / d*``."""
    rmse_m: float
    log_rmse: float
    """RMSE of ``ln d - ln d*``."""
    delta1: float
    """Share of pixels with ``max(d/d*, d*/d) < 1.25``."""
    delta2: float
    """The same below ``1.25^2``."""
    delta3: float
    """The same below ``1.25^3``."""
    scale: float
    """Factor applied to the prediction: 1 for metric figures, the ratio of medians for scaled ones."""


DepthReport = dict[str, DepthScore]
"""Scores by `TITLES`' names; those of edges are missing without an image."""
TITLES = {
    "metric": "metric",
    "median_scaled": "median-scaled",
    "edges_metric": "edges, metric",
    "edges_median_scaled": "edges, median-scaled",
}
"""As they are, and after median scaling of each map: the error if scale comes from elsewhere; all pixels, or edges."""


def score_depth(
    prediction: FloatArray, truth: FloatArray, mask: NDArray[np.bool_] | None = None, median_scaled: bool = False
) -> DepthScore:
    """Errors of one depth map.

    Args:
        prediction: Depth ``(H, W)`` [m].
        truth: Measured depth ``(H, W)`` [m]; 0, negative or not finite where nothing was measured.
        mask: Pixels ``(H, W)`` to evaluate; all measured ones by default.
        median_scaled: Multiply the prediction by ``median(truth) / median(prediction)`` of those pixels first.

    Raises:
        EvaluationError: If the shapes differ or no pixel is left.

    Example:
        >>> score_depth(np.full((2, 2), 1.1), np.ones((2, 2))).abs_rel
        0.10000000000000009
    """
    prediction, truth = np.squeeze(prediction), np.squeeze(truth)
    if prediction.shape != truth.shape:
        raise EvaluationError(f"the predicted depth map is {prediction.shape}, the measured one {truth.shape}")
    valid = np.isfinite(truth) & (truth > 0) & np.isfinite(prediction) & (True if mask is None else mask)
    if not valid.any():
        raise EvaluationError("no pixel has both a measured and a predicted depth")
    d, truth = prediction[valid].astype(np.float64), truth[valid].astype(np.float64)
    middle = float(np.median(d))
    if median_scaled and middle <= 0:
        raise EvaluationError("the predicted depth map is not positive")
    scale = float(np.median(truth)) / middle if median_scaled else 1.0
    d = np.maximum(d * scale, MIN_DEPTH_M)
    ratio = np.maximum(d / truth, truth / d)
    one, two, three = (float(np.mean(ratio < 1.25**k)) for k in (1, 2, 3))
    abs_rel, rmse = float(np.mean(np.abs(d - truth) / truth)), float(np.sqrt(np.mean((d - truth) ** 2)))
    return DepthScore(len(d), abs_rel, rmse, float(np.sqrt(np.mean(np.log(d / truth) ** 2))), one, two, three, scale)


def report_depth(prediction: FloatArray, truth: FloatArray, image: NDArray[np.uint8] | None = None) -> DepthReport:
    """All four figures of one map; ``image`` ``(H, W[, 3])`` of the same size gives the edges."""
    masks: dict[str, NDArray[np.bool_] | None] = {"": None}
    if image is not None and ((edges := edge_mask(image)) & (np.squeeze(truth) > 0)).any():
        masks["edges_"] = edges
    return {
        f"{where}{kind}": score_depth(prediction, truth, mask, median_scaled=kind == "median_scaled")
        for where, mask in masks.items()
        for kind in ("metric", "median_scaled")
    }


def edge_mask(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Canny edges ``(H, W)`` of an 8-bit image, the thresholds of the map evaluation."""
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return cv2.Canny(cv2.GaussianBlur(grey, (0, 0), 1.0), 50.0, 150.0, L2gradient=True) > 0


def mean_score(scores: Iterable[DepthScore]) -> DepthScore:
    """Mean over maps, as the literature averages; pixels are summed."""
    found = list(scores)
    if not found:
        raise EvaluationError("no depth map was judged")
    names = ("abs_rel", "rmse_m", "log_rmse", "delta1", "delta2", "delta3", "scale")
    means = {name: float(np.mean([getattr(s, name) for s in found])) for name in names}
    return DepthScore(pixels=sum(s.pixels for s in found), **means)


def mean_report(reports: Iterable[DepthReport]) -> DepthReport:
    """Mean over maps of all four figures; edges over the maps that have any."""
    found = list(reports)
    there = [name for name in TITLES if any(name in report for report in found)]
    return {name: mean_score(report[name] for report in found if name in report) for name in there}


def read_depth(path: Path, metres_per_unit: float = 1.0 / 5000.0) -> FloatArray:
    """Depth map ``(H, W)`` [m] from ``.npy`` (metres) or a 16-bit PNG.

    Raises:
        EvaluationError: If the file is neither.
    """
    if path.suffix == ".npy":
        try:
            return np.squeeze(np.load(path, allow_pickle=False)).astype(np.float64)
        except (OSError, ValueError) as error:
            raise EvaluationError(f"{path}: not a NumPy array ({error})") from error
    raw = pixels_or_none(path, cv2.IMREAD_UNCHANGED)
    if raw is None or raw.dtype != np.uint16 or raw.ndim != 2:
        raise EvaluationError(f"{path}: not a 16-bit depth map or .npy array")
    return np.where(raw == 65535, 0, raw).astype(np.float64) * metres_per_unit


def compare_folders(
    prediction: Path, truth: Path, metres_per_unit: float = 1.0 / 5000.0, images: Path | None = None
) -> DepthReport:
    """Mean figures over the maps that two folders (or files) share by name.

    Args:
        prediction: Folder or file to evaluate; ``.npy`` takes precedence over ``.png``.
        truth: Folder or file of measured depth.
        metres_per_unit: Depth of one unit of a PNG [m].
        images: Folder or file of images of the same names and size: their edge pixels are judged alone too.

    Raises:
        EvaluationError: If no name is in both.
    """
    if prediction.is_file() and truth.is_file():
        pairs = [(prediction, truth, images)]
    else:
        known, pictures = _named(truth, _MAPS), {} if images is None else _named(images, _PICTURES)
        pairs = [(path, known[n], pictures.get(n)) for n, path in _named(prediction, _MAPS).items() if n in known]
    if not pairs:
        raise EvaluationError(
            f"{prediction} and {truth} share no depth map by name (.npy or 16-bit .png); for predictions named after "
            "a recording's colour images, give the recording's own folder as ground truth"
        )
    return mean_report(
        report_depth(
            read_depth(a, metres_per_unit), read_depth(b, metres_per_unit), None if image is None else _grey(image)
        )
        for a, b, image in pairs
    )


def compare_with_recording(prediction: Path, folder: Path) -> DepthReport:
    """Mean figures over the maps of a folder, named after a recording's images, against its measured depth.

    Depth maps and colour images have stamps of their own: the nearest within 20 ms is taken, undistorted, and turned to
    the colour camera where it is not registered. The images give the edges.

    Raises:
        EvaluationError: If the recording has no depth maps, or none belongs to a prediction.
    """
    (sequence, measured, camera), maps, reports = open_depth(folder), _named(prediction, _MAPS), []
    for entry in sequence.images:
        index = int(nearest(measured.stamps_s, np.array([entry.stamp_s]))[0])
        if entry.path.stem not in maps or abs(measured.stamps_s[index] - entry.stamp_s) > DEFAULT_MAX_DT_S:
            continue
        truth = measured.read_registered(index, camera)
        image = np.asarray(camera.undistort_image(_grey(entry.path)), np.uint8)
        reports.append(report_depth(read_depth(maps[entry.path.stem], 1e-3), truth, image))
    if not reports:
        raise EvaluationError(
            f"{prediction}: no depth map is named after an image of {folder} that has measured depth within "
            f"{1e3 * DEFAULT_MAX_DT_S:.0f} ms ('edgeslam depth {folder} --out DIR' names them so)"
        )
    return mean_report(reports)


def _named(place: Path, suffixes: tuple[str, ...]) -> dict[str, Path]:
    """Files of a folder by name, later suffixes before others; coloured pictures of depth are ignored."""
    if place.is_file():
        return {place.stem: place}
    found = {p.stem: p for s in suffixes for p in sorted(place.iterdir()) if p.suffix.lower() == s}
    return {name: path for name, path in sorted(found.items()) if not name.endswith(("_colour", "_sigma"))}


def _grey(path: Path) -> NDArray[np.uint8]:
    image = pixels_or_none(path, cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise EvaluationError(f"{path}: not an image")
    return np.asarray(image, dtype=np.uint8)
