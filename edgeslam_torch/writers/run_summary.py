"""``summary.json``: a run in numbers."""

import math
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from edgeslam_torch import __version__
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.geometry.level import Up
from edgeslam_torch.readers.source import Source
from edgeslam_torch.types import Piece, ScaleEstimate, SlamOutput

MAX_PROBLEMS = 100
"""Listed in the summary one by one; ``left_out`` counts them all."""


@dataclass(slots=True)
class Tally:
    """Counts over a run, a few numbers per frame."""

    frames: int = 0
    supported: int = 0
    """Frames whose live pose was supported by the map."""
    lost_events: int = 0
    first_pose_frame: int | None = None
    statuses: dict[str, int] = field(default_factory=dict)
    stage_ms: dict[str, list[float]] = field(default_factory=dict)
    step_ms: list[float] = field(default_factory=list)
    last_reason: str = ""
    """Reason of the last frame that was not ordinarily tracked."""
    _was_lost: bool = False

    def add(self, output: SlamOutput, step_ms: float) -> None:
        """Count one frame."""
        has_pose = output.status.supported
        if has_pose and self.first_pose_frame is None:
            self.first_pose_frame = output.index
        is_lost = not has_pose and self.first_pose_frame is not None
        self.lost_events += is_lost and not self._was_lost
        self._was_lost = is_lost
        self.last_reason = output.reason or self.last_reason
        self.frames += 1
        self.supported += has_pose
        self.statuses[str(output.status)] = self.statuses.get(str(output.status), 0) + 1
        self.step_ms.append(step_ms)
        for stage, ms in output.stage_ms.items():
            self.stage_ms.setdefault(stage, []).append(ms)


def summarise(
    source: Source,
    tally: Tally,
    pieces: Sequence[Piece],
    scale: ScaleEstimate,
    dropped: int,
    loop_s: float,
    finish_s: float,
    cpu_s: float,
) -> dict[str, Any]:
    """The common part of the summary; the caller adds the rest.

    Args:
        source: What was run on.
        tally: Of at least one frame.
        pieces: Final pieces.
        scale: At the end.
        dropped: Frames dropped in real time.
        loop_s: Time from the first frame to the last.
        finish_s: Time of the last refinement.
        cpu_s: User and system time of the whole process, all threads, over both intervals.
    """
    left_out = sum(problem.frames for problem in source.problems)
    offered = tally.frames + dropped + left_out
    tracked = sum(piece.supported for piece in pieces)
    return {
        "version": __version__,
        "source": {"name": source.name, "kind": source.kind, "path": source.location, "length": source.length},
        "camera": _camera(source.camera),
        "frames": tally.frames,
        "offered": offered,
        "tracked": tracked,
        "tracked_live": tally.supported,
        "coverage": tracked / offered,
        "pieces": [asdict(piece) for piece in pieces],
        "first_pose_frame": tally.first_pose_frame,
        "lost_events": tally.lost_events,
        "dropped_frames": dropped,
        "left_out": left_out,
        "statuses": tally.statuses,
        "last_reason": tally.last_reason,
        "duration_s": loop_s + finish_s,
        "finish_s": finish_s,
        "fps": tally.frames / loop_s if loop_s > 0 else None,
        "cpu_ms_per_frame": 1e3 * cpu_s / tally.frames,
        "peak_rss_mb": peak_rss_mb(),
        "step_ms": {"median": float(np.median(tally.step_ms)), "p95": float(np.percentile(tally.step_ms, 95))},
        "stage_median_ms": {stage: float(np.median(ms)) for stage, ms in tally.stage_ms.items()},
        "stage_mean_ms_per_frame": {stage: sum(ms) / tally.frames for stage, ms in tally.stage_ms.items()},
        "scale": {"value": scale.value, "sigma": scale.sigma, "source": scale.source, "units": str(scale.units)},
        "telemetry_samples": len(source.telemetry),
        "imu_readings": 0 if source.imu_readings is None else len(source.imu_readings),
        "problems": [{"file": problem.file, "reason": problem.reason} for problem in source.problems[:MAX_PROBLEMS]],
    }


def up_in_words(up: Up | None) -> dict[str, Any]:
    """Source and accuracy of gravity; ``unknown`` where z is up in the first camera."""
    if up is None:
        return {"source": "unknown", "sigma_deg": None}
    off_rad = math.acos(min(1.0, float(up.direction[2])))  # nothing, but in the axes of an earlier flight
    return {"source": up.source, "sigma_deg": math.degrees(math.hypot(up.sigma_rad, off_rad))}


def vertical_text(up: Any) -> str:
    """A summary's ``up`` for the world's z axis; other values are ignored."""
    match up:
        case {"source": str(source), "sigma_deg": int() | float() as sigma_deg} if source != "unknown":
            return f"z up by {source.replace('+', ' and ')}, sigma {sigma_deg:.1f} degrees"
    return "z as the first camera had it: up is not known"


def without_folders(summary: dict[str, Any], folder: Path) -> dict[str, Any]:
    """The summary without absolute paths: files by their names within the recording, and the recording relative to
    the run's ``folder``; both stay valid when the two are moved together.
    """
    source = summary["source"]
    if source["kind"] == "live":
        return summary
    location = Path(source["path"])
    short = _replaced_in(summary, f"{location}{os.sep}", "")
    try:
        short["source"]["path"] = os.path.relpath(location, folder.resolve())
    except ValueError:  # Windows: on another drive
        short["source"]["path"] = location.name
    return short


def _replaced_in(value: Any, old: str, new: str) -> Any:
    if isinstance(value, dict):
        return {key: _replaced_in(item, old, new) for key, item in value.items()}
    if isinstance(value, list):
        return [_replaced_in(item, old, new) for item in value]
    return value.replace(old, new) if isinstance(value, str) else value


def _camera(camera: Camera) -> dict[str, Any]:
    return {
        name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy", "focal_sigma", "source")
    }


def peak_rss_mb() -> float | None:
    """Largest memory of this process so far [MB]; None where unavailable.

    Linux keeps ``ru_maxrss`` over ``exec``: a small process that a large one starts reports its parent's.
    """
    with suppress(OSError, ValueError, IndexError):
        status = Path("/proc/self/status").read_text("ascii", "replace")
        return int(status.partition("VmHWM:")[2].split()[0]) / 2**10
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (2**20 if sys.platform == "darwin" else 2**10)
