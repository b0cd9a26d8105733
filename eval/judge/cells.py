"""Cells of the judge: one source with one seed each."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.dataset import open_dataset
from edgeslam_torch.eval.judge import sources
from edgeslam_torch.eval.judge.flights import NONE
from edgeslam_torch.eval.judge.telemetry.simulated_telemetry import KINDS
from edgeslam_torch.readers.source import Recording
from edgeslam_torch.synthetic.flights.courses import COURSES

SETS = ("base", "variants", "flights", "telemetry", "all")
"""What ``--set`` takes: recordings as they are, their variants, simulations, telemetry along them, everything."""

MIN_FRAMES = 30
"""Shorter recordings, and variants that leave fewer, are not judged."""

KIDNAP = ((0, 250), (420, 600), (100, 250))
"""Frames of `KIDNAPPED`: away from a place without warning, and back to it."""
KIDNAPPED = "7scenes_redkitchen"
SECOND_FLIGHT = "second_flight"
"""Variant with two flights: the first saves its map, the second starts with it. Of `KIDNAPPED` the first and the second
`HALF` frames, of a simulation two paths through one world."""
HALF = 300
CUT, CUT_FRAMES = "cut", 160
"""Variant that joins this many frames of a simulation and of the next seed's: two places, two submaps."""
CUT_COURSES = ("room", "corridor")
FLOWN_AGAIN = ("room", "building")
"""Courses with a second flight: from another place, and from the first take-off."""
WITH_TELEMETRY = ("tum_fr1_xyz", "7scenes_redkitchen", "euroc_mh05_a", "tartan_hospital")
"""Recordings with simulated telemetry."""


@dataclass(frozen=True, slots=True)
class Variant:
    """A modified recording."""

    rate: int = 1
    """Every n-th frame."""
    shrink: int = 1
    """Factor by which images are reduced."""
    first: int = 0
    """Frame that it starts from."""
    focal: float = 1.0
    """Factor on the focal length given to the system."""
    perturb_px: float = 0.0
    """Start at the frame numbered as the seed with a perturbed calibration [px], to measure the scatter of results."""

    def frames_of(self, length: int) -> int:
        """Number of frames left of ``length``."""
        return max(0, -(-(length - self.first) // self.rate))

    def applied_to(self, recording: Recording, seed: int = 0) -> Recording:
        """The recording, changed; ``seed`` is the draw of a perturbation."""
        if self.perturb_px:
            recording = sources.perturbed(recording, seed, self.perturb_px)
        if self.first:
            recording = sources.start_at(recording, self.first)
        if self.rate > 1:
            recording = sources.every(recording, self.rate)
        if self.shrink > 1:
            recording = sources.smaller(recording, self.shrink)
        if self.focal != 1.0:
            recording = sources.with_focal_length(recording, self.focal)
        return recording


VARIANTS = {
    "half_rate": Variant(rate=2),
    "third_rate": Variant(rate=3),
    "half_size": Variant(shrink=2),
    "from_100": Variant(first=100),
    "from_200": Variant(first=200),
    "from_300": Variant(first=300),
    "focal_up": Variant(focal=1.03),
    "focal_down": Variant(focal=0.97),
    "perturbed": Variant(perturb_px=0.01),
}
"""Names after the slash in a cell's name."""

BACKWARDS = "backwards"
"""The variant that plays a recording from its end: an independent check, since nothing was tuned on it."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One run."""

    name: str
    """``RECORDING``, ``RECORDING/VARIANT``, ``flight/COURSE``, ``none/KIND`` or ``telemetry/KIND/RECORDING``."""
    seed: int
    """Seed of the system, of a simulation's world and of simulated telemetry."""
    folder: str = ""
    """Folder of the recording."""
    variant: str = ""
    """A name in `VARIANTS`, `BACKWARDS`, ``kidnap``, `CUT` or `SECOND_FLIGHT`."""
    course: str = ""
    """Course of a simulated flight: a name in `courses.COURSES`."""
    nothing: str = ""
    """Source without usable images: a name in `flights.NONE`."""
    telemetry: str = ""
    """Simulated telemetry: a name in `telemetry.simulated_telemetry.KINDS`."""

    @property
    def base(self) -> str:
        """Name of the cell that this one is a variant of; its own when it is none."""
        return self.name.rpartition("/")[0] if self.variant else self.name

    @property
    def slug(self) -> str:
        """Name of its folder."""
        return f"{self.name.replace('/', '__')}-s{self.seed}"

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def find_recordings(data: Path) -> dict[str, tuple[Path, int]]:
    """Folders with a known layout, ground truth and images, and their numbers of frames, by name.

    ``data`` itself, its folders and theirs are looked at.

    Raises:
        EvaluationError: If ``data`` is no folder.
    """
    if not data.is_dir():
        raise EvaluationError(f"{data}: no such folder of recordings (DATA or EDGESLAM_DATA)")
    found: dict[str, tuple[Path, int]] = {}
    for folder in (data, *_folders(data)):
        if any(folder.is_relative_to(other) for other, _ in found.values()):
            continue
        try:
            dataset = open_dataset(folder)
        except EdgeSlamError:
            continue
        if len(dataset.frame_stamps_s) >= MIN_FRAMES:
            name = dataset.name if dataset.name not in found else f"{folder.parent.name}_{dataset.name}"
            found[name] = (folder.resolve(), len(dataset.frame_stamps_s))
    return found


def _folders(data: Path) -> list[Path]:
    children = sorted(p for p in data.iterdir() if p.is_dir())
    return [*children, *(g for child in children for g in sorted(child.iterdir()) if g.is_dir())]


def list_cells(data: Path | None, which: str, seeds: Sequence[int], only: Sequence[str] = ()) -> list[Cell]:
    """Cells of a set, seed by seed within a name.

    Args:
        data: Folder of recordings; None leaves them out.
        which: One of `SETS`.
        seeds: Of every cell.
        only: Patterns such as ``tum_*``; a cell's name must match one. All when empty.

    Raises:
        EvaluationError: If nothing is left to judge.
    """
    if which not in SETS:
        raise EvaluationError(f"no set {which!r}; there are {', '.join(SETS)}")
    made: list[Cell] = []
    recordings = find_recordings(data) if data is not None else {}
    for name, (folder, frames) in recordings.items():
        variants = [v for v, change in VARIANTS.items() if change.frames_of(frames) >= MIN_FRAMES]
        variants.append(BACKWARDS)
        wanted = ([""] if which in ("base", "all") else []) + (variants if which in ("variants", "all") else [])
        wanted += ["kidnap"] if which in ("flights", "all") and _can_kidnap(name, frames) else []
        wanted += [SECOND_FLIGHT] if which in ("flights", "all") and _can_kidnap(name, frames) else []
        made += [_cell(name, folder, variant) for variant in wanted]
        if which in ("telemetry", "all") and name in WITH_TELEMETRY:
            made += [Cell(f"telemetry/{kind}/{name}", 0, str(folder), telemetry=kind) for kind in KINDS]
    if which in ("flights", "all"):
        made += [Cell(f"flight/{course}", 0, course=course) for course in COURSES]
        made += [Cell(f"flight/{c}/{SECOND_FLIGHT}", 0, variant=SECOND_FLIGHT, course=c) for c in FLOWN_AGAIN]
        made += [Cell(f"flight/{course}/{CUT}", 0, variant=CUT, course=course) for course in CUT_COURSES]
        made += [Cell(f"none/{kind}", 0, nothing=kind) for kind in NONE]
    kept = [cell for cell in made if not only or any(fnmatchcase(cell.name, pattern) for pattern in only)]
    if not kept:
        there = ", ".join(dict.fromkeys(cell.name for cell in made)) or "none (no recordings: DATA or EDGESLAM_DATA)"
        raise EvaluationError(f"no cell matches; there are: {there}")
    return [replace(cell, seed=seed) for cell in kept for seed in seeds]


def _can_kidnap(name: str, frames: int) -> bool:
    return name == KIDNAPPED and frames >= max(last for _, last in KIDNAP)


def _cell(name: str, folder: Path, variant: str) -> Cell:
    return Cell(f"{name}/{variant}" if variant else name, 0, str(folder), variant)
