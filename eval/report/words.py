"""The report's sentences and tables: what a run's numbers mean, in plain words."""

import math
import re
from pathlib import Path
from typing import Any

from edgeslam_torch.eval.inputs.run_folder import RunFolder, is_supported, number, record
from edgeslam_torch.eval.metrics.align import travelled
from edgeslam_torch.eval.metrics.run_score import RunScore

_MOST_SAID = 5
"""Joins and loops that the story names."""
_LEADING = re.compile(
    r"(?<![\w.:/\\<])"  # where a word begins: the slashes of 6/s, rtsp://host and </tag> are none
    r"(?:(?:\.\.[\\/])+|[A-Za-z]:[\\/]|\\\\|/)(?=[^\s/\\:;,'\"<>|])"
    r"(?:[^/\\\n:;,'\"<>|]*[^\s/\\:;,'\"<>|][/\\])*"
)
"""A path from the root or from folders above, up to its last name; folders may have spaces inside their names."""


def _count(value: object) -> int:
    return int(number(value)) if math.isfinite(number(value)) else 0


def unit(run: RunFolder) -> str:
    """``m``, or ``units`` while the scale is unknown."""
    return "units" if run.units == "arbitrary" else "m"


def title(run: RunFolder) -> str:
    """Name of the recording, else of the folder."""
    source = run.summary.get("source")
    source = source if isinstance(source, dict) else {"path": source}
    if isinstance(name := source.get("name"), str) and name:
        return readable(name)
    path = source.get("path")
    return readable(Path(path).name if isinstance(path, str) and path else run.name)


def readable(text: str) -> str:
    """Text that UTF-8 can write: bytes of a file name that are no UTF-8 become question marks."""
    return text.encode("utf-8", errors="replace").decode("utf-8")


def without_folders(text: str) -> str:
    """Paths that leave the run's folder, by their last name: a shared page must not reveal local paths."""
    return _LEADING.sub("", text)


def story(run: RunFolder, score: RunScore | None) -> str:
    """What was run and how it went."""
    summary, frames = run.summary, _offered(run) or len(run.trajectory)
    seconds = float(run.trajectory.stamps_s[-1] - run.trajectory.stamps_s[0])
    sentences = [f"{frames} frames, {seconds:.1f} s of recording."]
    for key, what in (("left_out", "left out: they could not be used"), ("dropped_frames", "dropped to keep up")):
        if _count(summary.get(key)):
            sentences.append(f"{_count(summary.get(key))} of them were {what}.")
    if run.status:
        sentences += _tracking(run, frames)
    sentences += [_scale_sentence(run), _pieces_sentence(summary), _found_again_sentence(summary)]
    if score is not None:
        sentences.append(
            f"Against ground truth the camera is off by {_length(score.ate_sim3_m)} (RMSE after scaling; a camera that "
            f"never moved would score {_length(score.fixed_position_m)})."
        )
        if score.units == "metres":
            off = abs(1.0 / (1.0 + score.scale_error) - 1.0)
            words = f"{100 * off:.1f} % too {'small' if score.scale_error > 0 else 'large'}"
            sentences.append(f"Without scaling it is {_length(score.ate_se3_m)}; lengths are {words}.")
    if summary.get("interrupted"):
        sentences.append("The run was interrupted; this is what was done until then.")
    return " ".join(s for s in sentences if s).replace(" %", "\u00a0%")


def _tracking(run: RunFolder, frames: int) -> list[str]:
    """How much was tracked, from when on, and how often tracking was lost."""
    tracked, lost = run.trusted_frames, run.summary.get("lost_events")
    first = next((index for index, row in enumerate(run.status) if is_supported(row)), None)
    begin = {None: "", 0: ", from the first on"}.get(first, f", the first of them frame {first}")
    if tracked < frames:
        sentences = [f"{100.0 * tracked / max(1, frames):.1f} % of the frames were tracked against the map{begin}."]
    elif lost:  # each was given its place by the end
        sentences = [f"Every frame has a place in the final map{begin}."]
    else:
        sentences = [f"Every frame was tracked against the map{begin}."]
    if isinstance(lost, int) and (lost or tracked):
        times = {1: "once", 2: "twice"}.get(lost, f"{lost} times")
        sentences.append(f"While running, tracking was lost {times}." if lost else "Tracking was never lost.")
    return sentences


def warnings(summary: dict[str, Any]) -> list[str]:
    """What the run warned of."""
    said = summary.get("warnings")
    return [without_folders(str(sentence)) for sentence in said] if isinstance(said, list) else []


Value = tuple[str, float, int, str]
"""Name, value (NaN where there is none), digits after the point, and unit of a figure."""

_ON_TILES = {
    "position error (ATE, Sim(3))",
    "map error (median)",
    "frames tracked",
    "edge points",
    "scale, 1 sigma",
    "up, 1 sigma",
    "frames per second",
    "CPU per frame",
    "memory",
}


def figures(run: RunFolder, score: RunScore | None) -> list[Value]:
    """What the pages show of a run in numbers."""
    summary, frames = run.summary, _offered(run)
    counts = record(summary.get("map"))
    ate_m, se3_m, rotation_deg, map_m = [math.nan] * 4
    if score is not None:
        ate_m, rotation_deg = score.ate_sim3_m, score.rotation_deg
        se3_m = score.ate_se3_m if score.units == "metres" else math.nan
        map_m = score.map.median_m if score.map is not None else math.nan
    return [
        ("position error (ATE, Sim(3))", 100 * ate_m, 2, "cm"),
        ("position error without scaling (SE(3))", 100 * se3_m, 2, "cm"),
        ("rotation error", rotation_deg, 2, "\u00b0"),
        ("map error (median)", 100 * map_m, 2, "cm"),
        ("frames", frames or len(run.trajectory), 0, ""),
        ("frames tracked", 100.0 * run.trusted_frames / frames if frames and run.status else math.nan, 1, "%"),
        ("times lost", number(summary.get("lost_events")), 0, ""),
        ("scale, 1 sigma", 100 * run.scale_sigma if run.units == "metres" else math.nan, 1, "%"),
        ("up, 1 sigma", number(record(summary.get("up")).get("sigma_deg")), 1, "\u00b0"),
        ("length of the path", float(travelled(run.trajectory.positions)[-1]), 2, unit(run)),
        ("keyframes", number(counts.get("keyframes")), 0, ""),
        ("anchors", number(counts.get("anchors")), 0, ""),
        ("edge points", number(counts.get("edge_points")), 0, ""),
        ("frames per second", number(summary.get("fps")), 1, ""),
        ("CPU per frame", number(summary.get("cpu_ms_per_frame")), 1, "ms"),
        ("memory", number(summary.get("peak_rss_mb")), 0, "MB"),
    ]


def tiles(run: RunFolder, score: RunScore | None) -> list[dict[str, str]]:
    """Key figures at the top of the page; of scale and vertical also that they are not known."""
    out = []
    for name, value, digits, unit_ in figures(run, score):
        what, stated, _ = name.partition(", 1 sigma")
        if name in _ON_TILES and math.isfinite(value):
            sign = "\u00b1" if stated else ""
            out.append((f"{sign}{value:,.{digits}f}".replace(",", "\u2009"), unit_, name))
        elif stated and record(run.summary.get(what)):
            out.append(("unknown", "", what))
    return [{"value": value, "unit": unit_, "label": name} for value, unit_, name in out]


def foot(run: RunFolder) -> str:
    """Settings and versions of the run."""
    parts = ["Made by EdgeSLAM-Torch"]
    for key in ("version", "commit", "mode", "seed", "camera", "command", "started"):
        value = run.summary.get(key)
        value = value.get("source") if isinstance(value, dict) else value
        parts += [f"{key} {without_folders(str(value))}"] if value not in (None, "") else []
    return ", ".join(parts) + "."


def scale_note(run: RunFolder) -> str:
    """Where the scale comes from."""
    if not run.scale:
        return ""
    source = str(run.scale.get("source", "none"))
    return "No source of metric scale." if source == "none" else f"Source: {source.replace('+', ' and ')}."


def error_note(score: RunScore) -> str:
    """What the error charts show."""
    return (
        f"After Sim(3) alignment of {score.matched} poses with {score.dataset}: position RMSE "
        f"{_length(score.ate_sim3_m)}, rotation RMSE {score.rotation_deg:.2f} deg, scale factor {score.sim3.scale:.4f}."
    )


def map_rows(score: RunScore | None) -> list[list[str]] | None:
    """Rows of the map table."""
    if score is None or score.map is None:
        return None
    found = score.map
    rows = [
        ["points judged", f"{found.judged_share:.1%} of {found.points}"],
        ["median distance to the measured surface", _length(found.median_m)],
        ["the same, one depth map at a time", _length(found.single_map_median_m)],
        ["the same, after aligning the map itself", _length(found.own_alignment_median_m)],
        ["90 % of the points are nearer than", _length(found.p90_m)],
    ]
    for threshold, share in found.accuracy.items():
        gap = found.completeness.get(threshold)
        edges = f", {gap:.0%} of the true edges have a point that near" if gap is not None else ""
        rows.append([f"within {100 * threshold:.0f} cm", f"{share:.0%} of the points{edges}"])
    return rows


def flat_rows(summary: dict[str, Any], prefix: str = "") -> list[list[str]]:
    """``summary.json`` as rows of name and value."""
    rows: list[list[str]] = []
    for key, value in summary.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(value, dict):
            rows += flat_rows(value, f"{prefix}{key}: ")
        else:
            rows.append([name, f"{value:.6g}" if isinstance(value, float) else without_folders(_flat(value))])
    return rows


def keyframe_label(stem: str, begin: float) -> str:
    """Caption of a keyframe picture: its time into the run when its name is a stamp."""
    value = number(stem)
    is_stamp = math.isfinite(value) and "." in stem and value >= begin
    return f"{value - begin:.2f} s" if is_stamp else stem.replace("_", " ")


def _scale_sentence(run: RunFolder) -> str:
    if not run.scale:
        return ""
    if run.units == "arbitrary" or not math.isfinite(run.scale_sigma):
        return "No source determined the metric scale, so lengths are in arbitrary units."
    source = str(run.scale.get("source", "none")).replace("+", " and ")
    known = f"{100 * run.scale_sigma:.1f} % (1 sigma) from {source}"
    return f"Lengths are in metres, with the scale known to {known}."


def _pieces_sentence(summary: dict[str, Any]) -> str:
    listed = summary.get("pieces")
    pieces = [p for p in listed if isinstance(p, dict) and p.get("supported")] if isinstance(listed, list) else []
    if len(pieces) < 2:
        return ""
    spans = ", ".join(
        f"piece {p.get('number')} from {number(p.get('first_s')):.1f} to {number(p.get('last_s')):.1f} s"
        for p in pieces
    )
    return (
        f"The map is in {len(pieces)} pieces whose relation is not known: {spans}. This page is about the largest; "
        "the others have trajectory files of their own."
    )


def _found_again_sentence(summary: dict[str, Any]) -> str:
    """Joins of pieces and closed loops, with their evidence."""
    said = [text for key in ("joins", "loops") if isinstance(found := summary.get(key), list) for text in found]
    said = [text for text in said if isinstance(text, str) and text]
    more = f"; and {len(said) - _MOST_SAID} more" if len(said) > _MOST_SAID else ""
    return f"Places were seen again: {'; '.join(said[:_MOST_SAID])}{more}." if said else ""


def _length(metres: float) -> str:
    if not math.isfinite(metres):
        return "unknown"
    return f"{100 * metres:.1f}\u00a0cm" if metres < 1.0 else f"{metres:.2f}\u00a0m"


def _flat(value: object) -> str:
    """A list, or a list of records, without brackets and quotes."""
    if isinstance(value, list):
        return "; ".join(_flat(item) for item in value) or "none"
    return ", ".join(f"{key} {item}" for key, item in value.items()) if isinstance(value, dict) else str(value)


def _offered(run: RunFolder) -> int:
    """Frames that the source had: run through, left out and dropped; as the terminal counts them."""
    return _count(run.summary.get("offered")) or _count(run.summary.get("frames")) or len(run.status)
