"""Our own flight recordings: a TUM-layout folder or a video with ``camera.yaml`` and ``telemetry.csv``."""

from collections.abc import Sequence
from pathlib import Path

from edgeslam_torch.errors import SourceError
from edgeslam_torch.io import video
from edgeslam_torch.io.tum import read_list
from edgeslam_torch.types import TelemetrySample

TELEMETRY = "telemetry.csv"


def telemetry_file(folders: Sequence[Path], given: str | Path | None) -> Path | None:
    """The file that was given, or the source's own ``telemetry.csv``.

    Raises:
        SourceError: If the given file does not exist.
    """
    if given is not None:
        path = Path(given).expanduser()
        if not path.is_file():
            raise SourceError(f"{path}: no such telemetry file")
        return path
    return next((folder / TELEMETRY for folder in folders if (folder / TELEMETRY).is_file()), None)


def read_samples(path: Path) -> list[TelemetrySample]:
    """Telemetry in time order."""
    from edgeslam_torch.io.telemetry_csv import read_telemetry  # only flights need it

    return sorted(read_telemetry(path), key=lambda sample: sample.stamp_s)


def find_video(folder: Path) -> Path | None:
    """The folder's only video; None when it has none.

    Raises:
        SourceError: If it has several.
    """
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in video.SUFFIXES and p.is_file())
    if len(files) > 1:
        raise SourceError(f"{folder}: {len(files)} videos in it; give one of them, such as {files[0]}")
    return files[0] if files else None


def video_stamps(path: Path) -> list[float] | None:
    """Stamps of a recorded video's frames, from ``<video>_stamps.txt`` beside it (``stamp index`` a line)."""
    listing = path.with_name(f"{path.stem}_stamps.txt")
    if not listing.is_file():
        return None
    rows, _ = read_list(listing)
    return [stamp for stamp, _ in rows]
