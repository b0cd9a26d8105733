"""EuRoC MAV sequences as ETH publishes them: ``mav0/cam0/data.csv``, ``data/*.png``, ``sensor.yaml``."""

from pathlib import Path

from edgeslam_torch.errors import SourceError
from edgeslam_torch.readers.images import list_image_folder
from edgeslam_torch.readers.listing import ImageEntry, Problem, entries_in_time, nothing_listed, read_list
from edgeslam_torch.readers.sequence import Sequence

KIND = "euroc"


def camera_folder(folder: Path) -> Path | None:
    """``mav0/cam0`` of a sequence, given any of its levels; None if it is no EuRoC sequence."""
    for candidate in (folder / "mav0" / "cam0", folder / "cam0", folder):
        named = (candidate / "data.csv").is_file() or candidate.name.startswith("cam")
        if named and (candidate / "data").is_dir():
            return candidate
    return None


def groundtruth_of(folder: Path) -> Path | None:
    """The ground truth beside ``cam0``, of the body, nanosecond stamps."""
    for name in ("state_groundtruth_estimate0", "mocap0", "leica0"):
        path = folder.parent / name / "data.csv"
        if path.is_file():
            return path
    return None


def recognises(folder: Path) -> bool:
    """Whether it is a sequence, or its ``mav0`` or ``cam0``."""
    return camera_folder(folder) is not None


def read(folder: Path) -> Sequence:
    """Images of camera 0; the ground truth is the body's."""
    cam = camera_folder(folder)
    if cam is None:
        raise SourceError(f"{folder}: no mav0/cam0/data in it")
    images, problems = _images(cam)
    return Sequence(KIND, cam, tuple(images), tuple(problems), groundtruth_of(cam), name=folder.resolve().name)


def _images(folder: Path) -> tuple[list[ImageEntry], list[Problem]]:
    """Images of one ``camN`` folder in time order."""
    listing = folder / "data.csv"
    if not listing.is_file():
        return list_image_folder(folder / "data")
    rows, problems = read_list(listing)
    if not rows:
        raise nothing_listed(listing, "'nanoseconds,file name'", problems)
    stamps, names = zip(*rows, strict=True)
    kept, more = entries_in_time(stamps, [folder / "data" / name for name in names], str(listing), unit="ns")
    return kept, problems + more
