"""Our own flight recordings: a TUM-layout folder or a video with ``camera.yaml`` and ``telemetry.csv``."""

from collections.abc import Sequence
from pathlib import Path

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers import video
from edgeslam_torch.readers.listing import Problem, image_times, read_list
from edgeslam_torch.types import TelemetrySample

TELEMETRY = "telemetry.csv"
_HOLE_S = 1.0
_HOLE_SHARE = 0.05
"""Ten messages in a row missing are a hole; holes over more than this share of the video are a warning."""


def telemetry_gap(samples: Sequence[TelemetrySample], first_s: float, last_s: float) -> str | None:
    """Warning about the part of a video without telemetry; None for small gaps or without any telemetry.

    Args:
        samples: In time order.
        first_s: Stamp of the first frame.
        last_s: Stamp of the last frame.
    """
    if not samples:
        return None
    begin_s, end_s = samples[0].stamp_s, samples[-1].stamp_s
    if end_s < first_s or begin_s > last_s:
        where = "before" if end_s < first_s else "after"
        return (
            f"no telemetry during the video: all of it ({begin_s:.1f} to {end_s:.1f} s) is stamped {where} the frames "
            f"({first_s:.1f} to {last_s:.1f} s), and none is used; do both clocks count the same seconds?"
        )
    inside = [first_s, *(s.stamp_s for s in samples if first_s <= s.stamp_s <= last_s), last_s]
    steps = (after - before for before, after in zip(inside, inside[1:], strict=False))
    missing_s = sum(step for step in steps if step > _HOLE_S)
    if missing_s <= _HOLE_SHARE * (last_s - first_s):
        return None
    return (
        f"no telemetry during {missing_s:.1f} of {last_s - first_s:.1f} s of video "
        f"(it runs from {begin_s - first_s:.1f} to {end_s - first_s:.1f} s after the first frame)"
    )


def find_video(folder: Path) -> Path | None:
    """The folder's only video, its small copies apart; None when it has none.

    Raises:
        SourceError: If it has several.
    """
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in video.SUFFIXES and p.is_file())
    files = [p for p in files if p.suffix.lower() not in video.PREVIEWS] or files
    if len(files) > 1:
        raise SourceError(f"{folder}: {len(files)} videos in it; give one of them, such as {files[0]}")
    return files[0] if files else None


def video_stamps(path: Path) -> tuple[list[float] | None, list[Problem]]:
    """Stamps of a recorded video's frames [s], from ``<video>_stamps.txt`` beside it (``stamp index`` a line), and
    remarks; None without it."""
    listing = path.with_name(f"{path.stem}_stamps.txt")
    if not listing.is_file():
        return None, []
    rows, _ = read_list(listing)
    stamps, remarks = image_times([stamp for stamp, _ in rows], str(listing))
    return stamps.tolist(), remarks
