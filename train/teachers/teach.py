"""The teacher for images without labels: dense depth from a run's poses and map, completed by a network.

Each view is swept against its neighbours (`plane_sweep`); pixels whose depth is confirmed by other views are kept.
The rest is the network's depth, corrected towards those pixels and the map's points (`densify`).
"""

import hashlib
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch import __version__
from edgeslam_torch.errors import SourceError
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.files.plain import subfolder
from edgeslam_torch.terminal.progress import counted
from edgeslam_torch.train.processes.distributed import everyones, rank, share_of
from edgeslam_torch.train.teachers.plane_sweep import sweep_depth
from edgeslam_torch.train.views.augment import View, fitted_view, scaled_K
from edgeslam_torch.train.views.posed import PosedSequence, PosedView, relative_motion
from edgeslam_torch.types import FloatArray

logger = logging.getLogger(__name__)

MOST = 100
"""Maximum number of views per sequence, evenly spread; 0.7 s of one core each."""
WIDTH, PLANES, NEIGHBOURS = 240, 48, 6
"""Of a sweep: image width [px], hypotheses, images compared with. 320 px and 64 planes cost twice as much and
confirm no more pixels."""
NEAR, FAR = 0.7, 1.5
"""Range of a sweep, relative to the nearest and farthest map points in view (first and last percentile)."""
CONFIRMING, TOLERANCE = 2, 0.05
"""Other views that must see a pixel at its depth, within this relative difference."""
ASKED = 6
"""Number of nearest views used for confirmation."""
SPACING = 4
"""Every n-th confirmed pixel corrects the network's depth around it."""
LOOKED_AT = 24
"""Views that say how many metres a map unit has."""


Predict = Callable[[PosedView], FloatArray]
"""Depth [m] of every pixel of a view ``(H, W)`` by a network; NaN where it has none."""


@dataclass(frozen=True, slots=True)
class Taught:
    """One view with depth everywhere."""

    view: View
    measured: NDArray[np.bool_]
    """``(H, W)``: where its depth was measured; elsewhere the network's own was completed."""


def kept_depth(root: Path, name: str, *content: object) -> Path:
    """Folder in ``root`` for the depth of a run, named by a hash of all that it depends on: what the run holds, the
    network, the scale."""
    return root / f"{name}-{hashlib.sha256(repr((content, __version__)).encode()).hexdigest()[:24]}"


def log_metres(predict: Predict, sequence: PosedSequence) -> float:
    """Log of metres per map unit by a network: the median over views of the median over their points.

    Raises:
        SourceError: If the network gives no depth at the map's points.
    """
    ratios = []
    for i in np.unique(np.linspace(0, len(sequence.views) - 1, LOOKED_AT).astype(int)).tolist():
        view = sequence.views[i]
        ratio = np.log(at_points(predict(view), view) / view.z)
        ratios += [float(np.median(ratio[np.isfinite(ratio)]))] if np.isfinite(ratio).any() else []
    if not ratios:
        raise SourceError(f"{sequence.name}: the network gives no depth at the map's points")
    return float(np.median(ratios))


def at_points(depth: FloatArray, view: PosedView) -> FloatArray:
    """Values of a map ``(H, W)`` at the map points of a view, ``(N,)``."""
    return depth[_nearest_pixels(view.uv, depth.shape)].astype(np.float64)


def _nearest_pixels(uv: FloatArray, shape: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of pixels ``(N, 2)``, those beyond the edge at the edge."""
    at = np.clip(np.rint(uv), 0, (shape[1] - 1, shape[0] - 1)).astype(np.intp)
    return at[:, 1], at[:, 0]


def teach(predict: Predict, sequence: PosedSequence, log_scale: float, folder: Path) -> list[Taught]:
    """Views of a run with dense depth [m], ``predict``'s where it was not measured; ``log_scale`` is the log of metres
    per map unit.

    The processes of a group share the work by way of ``folder``, whose files let an interrupted teacher resume.
    """
    subfolder(folder.parent, folder.name)
    count = min(MOST, len(sequence.views))
    chosen = np.unique(np.linspace(0, len(sequence.views) - 1, count).astype(int)).tolist()
    with_partners = [i for i in chosen if sequence.partners[i]]
    for i in counted(share_of(with_partners), f"{sequence.name}: depth by the run's poses", "image", shown=rank() == 0):
        if not (path := folder / f"swept_{i}.npy").is_file():
            _save(path, _sweep(sequence, i))
    everyones([])
    swept = {i: (np.load(folder / f"swept_{i}.npy"), sequence.views[i]) for i in with_partners}
    for i in counted(share_of(chosen), f"{sequence.name}: depth elsewhere", "image", shown=rank() == 0):
        if not (path := folder / f"dense_{i}.npy").is_file():
            measured = _confirmed(swept, i) if i in swept else np.zeros((1, 1), np.float32)
            _save(path, _completed(predict, sequence.views[i], measured, log_scale))
    everyones([])
    taught = []
    for i in chosen:
        view, signed = sequence.views[i], np.load(folder / f"dense_{i}.npy")
        taught.append(Taught(View(view.image, np.abs(signed), view.K), signed > 0))
    share = float(np.mean([t.measured.mean() for t in taught]))
    logger.info("%s: %.0f %% of %d images measured", sequence.name, 100 * share, len(taught))
    return taught


def _save(path: Path, array: FloatArray) -> None:
    write_atomically(path, lambda file: np.save(file, array))


def _sweep(sequence: PosedSequence, i: int) -> FloatArray:
    view = sequence.views[i]
    partners = sequence.partners[i]
    pick = np.unique(np.linspace(0, len(partners) - 1, min(NEIGHBOURS, len(partners))).astype(int))
    others = [sequence.views[partners[int(k)]] for k in pick]
    small = _small(view)
    low, high = np.percentile(view.z, (1, 99))
    inverse = np.linspace(1.0 / (FAR * high), 1.0 / (NEAR * low), PLANES)
    motions = [relative_motion(view, other) for other in others]
    return sweep_depth(_grey(small), [_grey(_small(other)) for other in others], motions, small.K, inverse)


Swept = Mapping[int, tuple[FloatArray, PosedView]]
"""Depth of views ``(H, W)`` float32 at the size of the sweep, in the run's unit, by their number."""


def _confirmed(swept: Swept, i: int) -> FloatArray:
    """Depth of view ``i`` where enough others agree, 0 elsewhere."""
    depth, view = swept[i]
    height, width = depth.shape
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(_swept_K(view, depth)).T
    p_w = (rays * depth[..., None]) @ view.T_w_c[:3, :3].T + view.T_w_c[:3, 3]
    agreeing = np.zeros((height, width), int)
    for j in _nearest(swept, i):
        other, seen = swept[j]
        p_j = ((p_w - seen.T_w_c[:3, 3]) @ seen.T_w_c[:3, :3]).astype(np.float32)
        z = np.maximum(p_j[..., 2], 1e-6)
        uv = (p_j / z[..., None]) @ _swept_K(seen, other).T.astype(np.float32)
        there = cv2.remap(other, uv[..., 0], uv[..., 1], cv2.INTER_NEAREST, borderValue=0)
        agreeing += np.abs(there / z - 1.0) < TOLERANCE
    return np.where(agreeing >= CONFIRMING, depth, 0.0).astype(np.float32)


def _swept_K(view: PosedView, depth: FloatArray) -> FloatArray:
    (height, width), (h, w) = depth.shape, view.image.shape[:2]
    return scaled_K(view.K, width / w, height / h)


def _nearest(swept: Swept, i: int) -> list[int]:
    """The views most like view ``i``: little moved relative to its depth, little turned."""
    depth, view = swept[i]
    away = float(np.median(depth))

    def distance(j: int) -> float:
        motion = relative_motion(swept[j][1], view)
        turn = float(np.arccos(np.clip((np.trace(motion[:3, :3]) - 1) / 2, -1, 1)))
        return float(np.linalg.norm(motion[:3, 3])) / away + 0.5 * turn

    return sorted((j for j in swept if j != i), key=distance)[:ASKED]


def _completed(predict: Predict, view: PosedView, measured: FloatArray, log_scale: float) -> FloatArray:
    """Depth [m] of every pixel ``(H, W)`` float32, negative where it was not measured, 0 where it is not known."""
    height, width = view.image.shape[:2]
    measured = np.asarray(cv2.resize(measured, (width, height), interpolation=cv2.INTER_NEAREST), np.float32)
    metres = np.exp(log_scale)
    predicted = predict(view)
    known = np.isfinite(predicted) & (predicted > 0)
    if not known.any():
        return measured * metres
    v, u = np.nonzero(measured)
    v, u = v[::SPACING], u[::SPACING]
    uv = np.concatenate([view.uv, np.stack([u, v], 1).astype(np.float32)])
    log_z = np.log(np.concatenate([view.z, measured[v, u]])) + log_scale
    there = known[_nearest_pixels(uv, known.shape)]
    filled = np.where(known, predicted, np.median(predicted[known]))
    dense = np.where(known, np.exp(densify(np.log(filled), uv[there], log_z[there])), 0.0) if there.any() else filled
    return np.where(measured > 0, measured * metres, -dense).astype(np.float32)


def _small(view: PosedView) -> View:
    height, width = view.image.shape[:2]
    whole = View.without_depth(view.image, view.K)
    return fitted_view(whole, (round(height * WIDTH / width), WIDTH)) if width > WIDTH else whole


def _grey(view: View) -> NDArray[np.float32]:
    return cv2.cvtColor(view.image, cv2.COLOR_BGR2GRAY).astype(np.float32)


SCALES = (0.15, 0.06, 0.025)
"""Standard deviations of the spreading, in image widths, coarse to fine."""
SHRINK = (0.3, 0.5, 1.0)
"""Prior weight at each scale, in points: finer corrections need more evidence."""
MAX_LOG_RATIO = 0.5
"""Points farther than this from the image's median ratio are occluded or wrong."""


def densify(log_depth: FloatArray, uv: FloatArray, log_z: FloatArray) -> FloatArray:
    """Log depth ``(H, W)`` corrected to pass near map points at pixels ``(N, 2)`` with log depths ``(N,)``."""
    height, width = log_depth.shape
    v, u = _nearest_pixels(uv, log_depth.shape)
    ratio = log_z - log_depth[v, u]
    median = float(np.median(ratio))
    kept = np.abs(ratio - median) < MAX_LOG_RATIO
    v, u, ratio = v[kept], u[kept], ratio[kept]
    correction = np.full((height, width), median, np.float32)
    count = np.zeros((height, width), np.float32)
    np.add.at(count, (v, u), 1.0)
    for scale, doubt in zip(SCALES, SHRINK, strict=True):
        sigma = scale * width
        rest = np.zeros((height, width), np.float32)
        np.add.at(rest, (v, u), ratio - correction[v, u])
        # A point's share in the middle of its own Gaussian is 1 / (2 pi sigma^2): uncertainty in points.
        weight = cv2.GaussianBlur(count, (0, 0), sigma) + doubt / (2 * np.pi * sigma**2)
        correction = correction + cv2.GaussianBlur(rest, (0, 0), sigma) / weight
    return log_depth + correction
