"""Run, evaluate and report one flight: what the process of a batch's case does."""

import shutil
from pathlib import Path
from typing import Any

import cv2

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import EdgeSlamError, OutputError
from edgeslam_torch.eval.metrics.run_score import RunScore, evaluate_run
from edgeslam_torch.eval.report.page import write_report
from edgeslam_torch.files.atomic import write_atomically, write_text
from edgeslam_torch.files.config_file import load_config
from edgeslam_torch.fleet.folder import FLIGHTS, PICTURES, WORK
from edgeslam_torch.readers.images import pixels_or_none
from edgeslam_torch.readers.source import open_source
from edgeslam_torch.run import run, settle_camera
from edgeslam_torch.writers.run_writer import PICTURE

CONFIG = "config.toml"
_FROM_ABOVE = (slice(44, None), slice(0, 650))
"""Rows and columns of a run's picture that show the map from above; all three views would be too small in a row."""
_PICTURE_WIDTH_PX = 400


def run_flight(task: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Leave a finished run in ``flights`` and a small picture; returns figures and notes.

    Args:
        task: As made by `BatchFolder.task`.
        folder: Of the task, in a batch's ``jobs``.

    Raises:
        EdgeSlamError: If it fails.
    """
    batch, name = Path(task["batch"]), task["name"]
    work = batch / WORK / name
    shutil.rmtree(work, ignore_errors=True)  # of a process that was killed
    if work.is_symlink():
        work.unlink()
    write_text(folder / CONFIG, task["config"])
    config = load_config(SlamConfig(), folder / CONFIG, ())
    source = open_source(
        task["recording"], task["camera"] or None, task["telemetry"] or None, task["max_frames"], task["topics"]
    )
    settle_camera(source)
    result = run(source, work, config)
    if result.interrupted or result.failure is not None:
        raise OutputError(result.failure or "interrupted")
    if not result.summary["tracked"]:
        raise OutputError(f"no frame was tracked against a map ({result.summary['last_reason'] or 'no reason known'})")
    truth = task["truth"] or (task["recording"] if source.groundtruth is not None else None)
    score, note = _score(work, truth, task["map_score"])
    write_report(work, truth if score is not None else None, judge_map=task["map_score"])
    _write_picture(work / PICTURE, batch / PICTURES / f"{name}.jpg")
    work.rename(batch / FLIGHTS / name)
    problems = [f"{'left out' if p.frames else 'note'}: {p.file}: {p.reason}" for p in source.problems[:3]]
    notes = [*problems, *result.summary["warnings"], *note, *(score.notes if score is not None else ())]
    return {"figures": figures(result.summary, score), "notes": notes}


def figures(summary: dict[str, Any], score: RunScore | None) -> dict[str, Any]:
    """The columns of the batch's table that one run fills."""
    scale = summary["scale"]
    metres = scale["units"] == "metres"
    found = {
        "frames": summary["frames"],
        "tracked": summary["coverage"],
        "lost": summary["lost_events"],
        "pieces": len(summary["pieces"]),
        "units": scale["units"],
        "scale_source": scale["source"] if metres else "",
        "scale_sigma": scale["sigma"] / scale["value"] if metres else None,
        "keyframes": summary["map"]["keyframes"],
        "edge_points": summary["map"]["edge_points"],
        "fps": summary["fps"],
        "cpu_ms": summary["cpu_ms_per_frame"],
        "memory_mb": summary["peak_rss_mb"],
    }
    if score is not None:
        found |= {
            "ate_m": score.ate_sim3_m,
            "ate_metric_m": score.ate_se3_m if metres else None,
            "online_m": score.ate_online_sim3_m,
            "scale_error": score.scale_error if metres else None,
            "rotation_deg": score.rotation_deg,
            "map_median_m": score.map.median_m if score.map is not None else None,
        }
    return found


def _score(work: Path, truth: str | None, map_score: bool) -> tuple[RunScore | None, list[str]]:
    """The run against its truth; why not, when there is one that cannot be used."""
    if truth is None:
        return None, []
    try:
        return evaluate_run(work, truth, judge_map=map_score), []
    except EdgeSlamError as error:
        return None, [f"not evaluated: {error}"]


def _write_picture(big: Path, small: Path) -> None:
    """The run's map from above at the size of a table's row."""
    image = pixels_or_none(big, cv2.IMREAD_COLOR)
    if image is None:
        return
    image = image[_FROM_ABOVE]
    height = round(image.shape[0] * _PICTURE_WIDTH_PX / image.shape[1])
    image = cv2.resize(image, (_PICTURE_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])[1]
    write_atomically(small, lambda file: file.write(jpeg.tobytes()))
