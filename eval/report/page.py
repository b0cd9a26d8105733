"""``report.html``: one self-contained page about a run, readable offline and on a phone.

The page's own text, style and script lie in ``template/``; this file packs a run's numbers into it. Points are
quantised to 11 bytes (three 16-bit coordinates, colour, logarithmic sigma, observations) and travel as base64.
"""

import base64
import html
import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.run_folder import RunFolder, is_keyframe, number, open_run
from edgeslam_torch.eval.inputs.trajectory_files import Trajectory
from edgeslam_torch.eval.metrics.run_score import RunScore, evaluate_run, finite
from edgeslam_torch.eval.report import words
from edgeslam_torch.eval.report.flight_section import flight_section
from edgeslam_torch.eval.report.keyframe_pictures import keyframe_pictures
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.plain import open_plain
from edgeslam_torch.readers.images import pixels_or_none
from edgeslam_torch.types import FloatArray, PointCloud
from edgeslam_torch.writers.own_folder import check_free

STATUSES = ("starting", "initialised", "tracked", "relocalised", "predicted", "lost")
"""In the order of the page's colours."""

MAX_POINTS = 200_000
"""More edge points than this are thinned at random (fixed seed) so that the page stays smooth and small."""

_MAX_ANCHORS = 50_000
_MAX_POSES = 6000
_MAX_KEYFRAMES = 12
_KEYFRAME_WIDTH_PX = 480
_MAX_FRUSTA = 60
_HEAD_BYTES = 10_000
PAGE = "report.html"
_TITLE_END = ", EdgeSLAM-Torch"
"""Of every page: what tells one from a file of others."""
TEMPLATE = Path(__file__).parent / "template"
_SCRIPTS = ("data.js", "viewer.js", "charts.js", "page.js")


def write_report(
    run_dir: Path | str,
    groundtruth: Path | str | None = None,
    out: Path | str | None = None,
    judge_map: bool = True,
) -> Path:
    """Write the report of a run and return its path.

    Args:
        run_dir: Output folder of ``edgeslam run``.
        groundtruth: Data set folder or trajectory file; None looks into the run's own source folder.
        out: File to write; ``report.html`` in the run's folder by default.
        judge_map: Compare the map with the data set's depth maps too (some ten seconds).

    Raises:
        EdgeSlamError: If the folder holds no run, or is a recording and ``out`` is None, or the given ground truth does
            not fit it.
    """
    run = open_run(run_dir)
    if run.path.is_file():
        raise EvaluationError(f"{run.path}: a report needs a run's folder, this is a single file")
    if out is None:
        outputs = () if _is_page(run.path / PAGE) else (PAGE,)
        check_free(run.path, outputs, remedy="give the folder of a run")
    out = Path(out) if out is not None else run.path / PAGE
    write_text(out, render(run, judge_run(run, groundtruth, judge_map)))
    return out


def _is_page(path: Path) -> bool:
    """Whether a file is such a page."""
    try:
        with open_plain(path) as file:
            return f"{_TITLE_END}</title>".encode() in file.read(_HEAD_BYTES)
    except OSError:
        return False


def render(run: RunFolder, score: RunScore | None = None) -> str:
    """The page as text."""
    edges = _subset(run.cloud("edge_map.ply"), MAX_POINTS)
    anchors = _subset(run.cloud("anchors.ply"), _MAX_ANCHORS)
    turn = upright(run.trajectory, score) if run.up == "unknown" else np.eye(3)
    data, packed_edges, packed_anchors = _payload(run, edges, anchors, score, turn)
    text = json.dumps(finite(data), allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
    script = "\n".join((TEMPLATE / name).read_text(encoding="utf-8") for name in _SCRIPTS)
    parts = {
        "style": (TEMPLATE / "style.css").read_text(encoding="utf-8"),
        "script": script,
        "title": html.escape(f"{data['title']}{_TITLE_END}"),
        "edges": packed_edges,
        "anchors": packed_anchors,
        "data": text,
        "flight": flight_section(run.source),
    }
    # In one pass: a recording may itself be called {{edges}}.
    page = (TEMPLATE / "page.html").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], page)


def judge_run(run: RunFolder, groundtruth: Path | str | None, judge_map: bool) -> RunScore | None:
    """Score; without a given ground truth, by what the source folder offers, if anything."""
    place = groundtruth if groundtruth is not None else run.own_truth
    if place is None:
        return None
    try:
        return evaluate_run(run.path, place, judge_map=judge_map)
    except EdgeSlamError:
        if groundtruth is not None:
            raise
        return None


def _payload(
    run: RunFolder, edges: PointCloud, anchors: PointCloud, score: RunScore | None, turn: FloatArray
) -> tuple[dict[str, Any], str, str]:
    shown = slice(None, None, max(1, -(-len(run.trajectory) // _MAX_POSES)))
    trajectory = run.trajectory.take(shown)
    begin = float(run.trajectory.stamps_s[0])
    positions = trajectory.positions @ turn.T
    table = _StatusTable(run, shown)
    edge_meta, edge_bytes = _packed(edges, turn)
    anchor_meta, anchor_bytes = _packed(anchors, turn)
    rotations = np.swapaxes(turn @ trajectory.T_w_c[:, :3, :3], 1, 2)  # rows are the camera's axes in the world
    config = run.path / "config.toml"
    settings = config.read_text(encoding="utf-8", errors="replace") if config.is_file() else None
    data: dict[str, Any] = {
        "title": words.title(run),
        "story": words.story(run, score),
        "warnings": words.warnings(run.summary),
        "tiles": words.tiles(run, score),
        "foot": words.foot(run),
        "unit": words.unit(run),
        "edges": edge_meta,
        "anchors": anchor_meta,
        "positions": _rounded(positions, 4),
        "rotations": _rounded(rotations, 4),
        "stamps": _rounded(trajectory.stamps_s - begin, 4),
        "time": [0.0, float(run.trajectory.stamps_s[-1] - begin)],
        "status": table.codes,
        "statusCounts": table.counts,
        "hasStatus": bool(run.status),
        "events": table.events(begin),
        "matches": table.column("matches"),
        "inliers": table.column("inliers"),
        "cameras": table.cameras(),
        "fov": [0.62, 0.46],
        "scale": table.scale(words.scale_note(run)),
        "stages": table.stages(),
        "truth": None if score is None else _truth_in_run(score, turn),
        "error": None if score is None else _error(score, begin),
        **_view(edges.p_w @ turn.T, positions, rotations),
        "keyframes": _keyframes(run, edges, trajectory.stamps_s[table.keyframes()], begin),
        "mapScore": words.map_rows(score),
        "summary": words.flat_rows(run.summary),
        "config": None if settings is None else words.without_folders(settings),
    }
    return data, edge_bytes, anchor_bytes


class _StatusTable:
    """``status.csv`` beside the poses that the page shows; any column may be missing."""

    def __init__(self, run: RunFolder, shown: slice) -> None:
        self.all_rows, self.rows = run.status, run.pose_rows[shown]
        self.codes = [_status_code(r) for r in self.rows]
        everything = [_status_code(r) for r in run.status] or self.codes
        self.counts = [everything.count(k) for k in range(len(STATUSES))]

    def column(self, name: str) -> list[float | None] | None:
        """Numbers of a column, None where missing; None when the file lacks it."""
        values = [number(r.get(name)) for r in self.rows]
        if not any(np.isfinite(values)):
            return None
        return [round(v, 5) if np.isfinite(v) else None for v in values]

    def keyframes(self) -> list[int]:
        """Poses of keyframes."""
        return [k for k, r in enumerate(self.rows) if is_keyframe(r)]

    def cameras(self) -> list[int]:
        """Poses drawn as frusta: the keyframes, thinned, or every so many poses."""
        index = self.keyframes() or list(range(0, len(self.rows), max(1, len(self.rows) // 30)))
        return index[:: max(1, -(-len(index) // _MAX_FRUSTA))]

    def scale(self, note: str) -> dict[str, Any] | None:
        """Scale over time with its 95 % interval, when the run had one."""
        value, sigma = self.column("scale"), self.column("scale_sigma")
        if value is None or sigma is None:
            return None
        both = list(zip(value, sigma, strict=True))
        ends = {"value": 0.0, "low": -1.96, "high": 1.96}
        return {
            name: [round(v + k * s, 5) if v is not None and s is not None else None for v, s in both]
            for name, k in ends.items()
        } | {"note": note}

    def stages(self) -> list[dict[str, Any]]:
        """Median and 95th percentile of every ``*_ms`` column over the frames in which the stage ran."""
        names = [n for n in (self.all_rows[0] if self.all_rows else {}) if n.endswith("_ms")]
        out = []
        for name in names:
            values = np.array([number(r.get(name)) for r in self.all_rows])
            values = values[np.isfinite(values) & (values > 0)]
            if len(values):
                label = "whole step" if name == "step_ms" else name.removesuffix("_ms").replace("_", " ")
                share = f" ({len(values)} frames)" if len(values) < 0.9 * len(self.all_rows) else ""
                median, p95 = np.quantile(values, [0.5, 0.95])
                out.append({"name": label + share, "median": float(median), "p95": float(p95)})
        return sorted(out, key=lambda s: -s["median"])

    def events(self, begin: float, most: int = 40) -> list[list[str]]:
        """Stretches that were not plainly tracked: from, to, frames, status, reason."""
        out: list[list[Any]] = []
        for row in self.all_rows:
            stamp, status, reason = number(row.get("stamp_s")), row.get("status", ""), row.get("reason", "")
            if status == "tracked" and not reason:
                out.append([])
                continue
            if out and out[-1] and out[-1][3] == status and out[-1][4] == reason:
                out[-1][1], out[-1][2] = stamp, out[-1][2] + 1
            else:
                out.append([stamp, stamp, 1, status, reason])
        rows = [r for r in out if r and (r[3] != "tracked" or r[2] > 2)]
        text = [[f"{a - begin:.2f} s", f"{b - begin:.2f} s", str(n), s, why] for a, b, n, s, why in rows[:most]]
        if len(rows) > most:
            text.append(["", "", "", "", f"and {len(rows) - most} more in status.csv"])
        return [[words.without_folders(cell) for cell in row] for row in text]


def _status_code(row: dict[str, str]) -> int:
    status = row.get("status", "tracked")
    return STATUSES.index(status) if status in STATUSES else STATUSES.index("lost")


def upright(trajectory: Trajectory, score: RunScore | None) -> FloatArray:
    """Rotation ``(3, 3)`` that turns the run's world so that z is up on the page.

    A run without telemetry assumes a level first camera; ground truth has the correct gravity if its z is up. Else a
    world in which the cameras' up is far from z (a trajectory that starts at the identity, z forward) is turned.
    """
    if score is not None and _camera_up(score.truth)[2] > 0.2:
        return score.sim3.alignment.R
    up = _camera_up(trajectory)
    if up[2] > 0.5 or not up.any():
        return np.eye(3)
    x = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _camera_up(trajectory: Trajectory) -> FloatArray:
    """Mean up direction of the images in the world, unit length; zero when they cancel."""
    up = -trajectory.T_w_c[:, :3, 1].mean(axis=0)
    norm = float(np.linalg.norm(up))
    return up / norm if norm > 1e-6 else np.zeros(3)


def _subset(cloud: PointCloud | None, most: int) -> PointCloud:
    if cloud is None:
        empty = np.zeros((0, 3), dtype=np.float32)
        return PointCloud(empty, empty.astype(np.uint8), empty[:, 0], empty[:, 0].astype(np.int32))
    keep = np.flatnonzero(np.isfinite(cloud.p_w).all(axis=1))
    if len(keep) > most:
        keep = np.sort(np.random.default_rng(0).choice(keep, most, replace=False))
    return PointCloud(cloud.p_w[keep], cloud.colour[keep], cloud.sigma_m[keep], cloud.observations[keep])


def _packed(cloud: PointCloud, turn: FloatArray) -> tuple[dict[str, Any], str]:
    """Range of the quantised values, and the bytes in base64."""
    p = np.asarray(cloud.p_w, dtype=np.float64) @ turn.T
    count = len(p)
    if count == 0:
        return {"count": 0, "lo": [0, 0, 0], "hi": [1, 1, 1], "sigma": [0.01, 1.0], "observations": [1, 2]}, ""
    # A handful of points flung far away must not cost the others their resolution: 65 536 steps over the range.
    lo, hi = np.quantile(p, [0.001, 0.999], axis=0)
    middle, reach = (lo + hi) / 2, np.maximum((hi - lo).max() * 1.5, 1e-6)
    lo, hi = np.maximum(p.min(axis=0), middle - reach), np.minimum(p.max(axis=0), middle + reach)
    extent = np.maximum(hi - lo, 1e-9)
    inside = np.flatnonzero(((p >= lo) & (p <= hi)).all(axis=1))
    inside = np.random.default_rng(0).permutation(inside)  # a page that cannot draw them all in time draws the first
    p, count = p[inside], len(inside)
    position = np.round((p - lo) / extent * 65535).astype("<u2")
    sigma, sigma_range = _log_codes(cloud.sigma_m[inside])
    most = max(2.0, float(np.quantile(cloud.observations, 0.98)))
    age = np.clip((cloud.observations[inside] - 1) / (most - 1) * 255, 0, 255).astype(np.uint8)
    packed = position.tobytes() + cloud.colour[inside].astype(np.uint8).tobytes() + sigma.tobytes() + age.tobytes()
    meta = {
        "count": count,
        "lo": _rounded(lo, 6),
        "hi": _rounded(lo + extent, 6),
        "sigma": sigma_range,
        "observations": [1, round(most)],
    }
    return meta, base64.b64encode(packed).decode("ascii")


def _log_codes(sigma: FloatArray) -> tuple[np.ndarray, list[float]]:
    """Sigma in 256 logarithmic steps between its 2 % and 98 % quantiles."""
    known = sigma[np.isfinite(sigma) & (sigma > 0)]
    if len(known) == 0:
        return np.full(len(sigma), 255, dtype=np.uint8), [0.01, 1.0]
    lo, hi = (float(v) for v in np.quantile(known, [0.02, 0.98]))
    hi = max(hi, 1.05 * lo)
    safe = np.where(np.isfinite(sigma) & (sigma > 0), sigma, hi)
    codes = np.clip(np.log(np.maximum(safe, 1e-12) / lo) / np.log(hi / lo), 0, 1) * 255
    return codes.astype(np.uint8), [float(f"{lo:.4g}"), float(f"{hi:.4g}")]


def _view(points: FloatArray, positions: FloatArray, rotations: FloatArray) -> dict[str, Any]:
    """Where the page's camera starts, how far the scene reaches, its floor and the heights at the ends of the colour
    ramp; robust against stray points."""
    lo, hi = positions.min(axis=0), positions.max(axis=0)
    low, high, floor = lo[2], hi[2], float("-inf")
    core = positions
    if len(points):
        a, b = np.quantile(points, [0.02, 0.98], axis=0)
        lo, hi = np.minimum(lo, a), np.maximum(hi, b)
        low, high, floor = a[2], b[2], float(np.quantile(points[:, 2], 0.005))
        # The far background is in the box of the flat views; the 3-D view starts on what most points are.
        core = np.concatenate([np.quantile(points, [0.05, 0.95], axis=0), positions])
    extent = np.maximum(hi - lo, 1e-3)
    lo, hi = lo - 0.03 * extent, hi + 0.03 * extent
    low, high = (float(low), float(high)) if len(points) else (float(lo[2]), float(hi[2]))
    floor = max(floor if len(points) else float(lo[2]), float(lo[2] - extent[2]))
    a, b = core.min(axis=0), core.max(axis=0)
    target, radius = (a + b) / 2, max(float(np.linalg.norm(b - a) / 2), 1e-3)
    # Start behind the cameras, a little to the side: the map is seen as they saw it.
    forward = rotations[:, 2].mean(axis=0)
    back = -forward if np.linalg.norm(forward[:2]) > 0.2 else positions.mean(axis=0) - target
    yaw = float(np.arctan2(back[1], back[0])) + 0.5
    steps = (0.05, 0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 25.0, 50.0)
    return {
        "home": {"target": _rounded(target, 4), "radius": round(radius, 4), "yaw": round(yaw, 4)},
        "box": {"lo": _rounded(lo, 4), "hi": _rounded(hi, 4)},
        "floor": round(floor, 4),
        "gridStep": next((step for step in steps if step > radius / 6), 100.0),
        "height": [round(h, 3) for h in (low, max(high, low + 1e-3))],
    }


def _truth_in_run(score: RunScore, turn: FloatArray) -> list[list[float]]:
    """True positions moved into the run's world, so that the map stays as the run made it."""
    found = score.sim3
    p = score.truth.positions[found.pairs[0][0] : found.pairs[0][-1] + 1]
    p = (p - found.alignment.t) @ found.alignment.R / found.alignment.scale
    return _rounded(p[:: max(1, -(-len(p) // _MAX_POSES))] @ turn.T, 4)


def _error(score: RunScore, begin: float) -> dict[str, Any]:
    found = score.sim3
    return {
        "t": _rounded(found.stamps_s - (begin + found.offset_s), 4),
        "cm": _rounded(100 * found.error_m, 3),
        "deg": _rounded(found.error_deg, 3),
        "note": words.error_note(score),
    }


def _keyframes(run: RunFolder, edges: PointCloud, stamps_s: FloatArray, begin: float) -> list[dict[str, str]]:
    """Pictures that the run left in ``keyframes/``, else drawn from its source's images."""
    files = sorted((run.path / "keyframes").glob("*.jpg")) if (run.path / "keyframes").is_dir() else []
    files = files[:: max(1, -(-len(files) // _MAX_KEYFRAMES))]
    pictures = [(words.keyframe_label(file.stem, begin), pixels_or_none(file, cv2.IMREAD_COLOR)) for file in files]
    if not files:
        chosen = stamps_s[:: max(1, -(-len(stamps_s) // _MAX_KEYFRAMES))]
        drawn = keyframe_pictures(run, edges, chosen)
        pictures = [(f"{stamp - begin:.2f} s", image) for stamp, image in drawn]
    return [{"src": _jpeg(image), "label": label} for label, image in pictures if image is not None]


def _jpeg(image: np.ndarray) -> str:
    """Small picture as a data URL."""
    if image.shape[1] > _KEYFRAME_WIDTH_PX:
        height = round(image.shape[0] * _KEYFRAME_WIDTH_PX / image.shape[1])
        image = cv2.resize(image, (_KEYFRAME_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.tobytes()).decode("ascii")


def _rounded(values: FloatArray, digits: int) -> list[Any]:
    return list(np.round(np.asarray(values, dtype=np.float64), digits).tolist())
