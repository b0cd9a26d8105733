"""Cells of the judge: one source with one seed each. `cases.toml` has what is special to a recording."""

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.inputs.dataset import find_recordings
from edgeslam_torch.eval.judge import sources
from edgeslam_torch.eval.judge.flights import NONE
from edgeslam_torch.eval.judge.simulated_imu import IMU_KINDS, RECORDED
from edgeslam_torch.eval.judge.simulated_telemetry import KINDS
from edgeslam_torch.readers.source import Recording
from edgeslam_torch.synthetic.flights.courses import COURSES

CASES: dict[str, Any] = tomllib.loads(Path(__file__).with_name("cases.toml").read_text(encoding="utf-8"))
MIN_FRAMES = 30
"""Shorter recordings, and variants that leave fewer, are not judged."""
BACKWARDS, KIDNAP, SECOND_FLIGHT, CUT = "backwards", "kidnap", "second_flight", "cut"
"""Variants of their own: played from the end (nothing was tuned on it); cut; two flights with one map; two worlds."""


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
        first = self.first
        if self.perturb_px:
            first, recording = seed, sources.perturbed(recording, seed, self.perturb_px)
        if (first, self.rate) != (0, 1):
            recording = recording.part(first, self.rate)
        if self.shrink > 1:
            recording = sources.smaller(recording, self.shrink)
        return sources.with_focal_length(recording, self.focal)


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


@dataclass(frozen=True, slots=True)
class Cell:
    """One run."""

    name: str
    """``RECORDING``, ``RECORDING/VARIANT``, ``flight/COURSE``, ``none/KIND``, ``telemetry/KIND/RECORDING`` or
    ``imu/KIND/RECORDING``, ``imu/KIND/COURSE``."""
    seed: int
    """Seed of the system, of a simulation's world and of simulated telemetry."""
    folder: str = ""
    """Folder of the recording."""
    variant: str = ""
    """A name in `VARIANTS`, or a variant of its own."""
    course: str = ""
    """Course of a simulated flight: a name in `courses.COURSES`."""
    nothing: str = ""
    """Source without usable images: a name in `flights.NONE`."""
    telemetry: str = ""
    """Simulated telemetry: a name in `simulated_telemetry.KINDS`."""
    imu: str = ""
    """A name in `simulated_imu.IMU_KINDS`, or `simulated_imu.RECORDED`."""

    @property
    def base(self) -> str:
        """Name of the cell that this one is a variant of; its own when it is none."""
        return self.name.rpartition("/")[0] if self.variant else self.name


def list_cells(data: Path | None, which: str, seeds: Sequence[int], only: Sequence[str] = ()) -> list[Cell]:
    """Cells of a set, seed by seed within a name.

    Args:
        data: Folder of recordings; None leaves them out.
        which: ``base``, images of recordings; ``variants`` of them; simulated ``flights``; simulated ``telemetry``;
            recorded and simulated ``imu``; ``all``.
        seeds: Of every cell.
        only: Patterns such as ``tum_*``; a cell's name must match one. All when empty.

    Raises:
        EvaluationError: If nothing is left to judge.
    """
    made = [cell for of, cell in (*_of_recordings(data), *_of_simulations()) if which in (of, "all")]
    kept = [cell for cell in made if not only or any(fnmatchcase(cell.name, pattern) for pattern in only)]
    if not kept:
        there = ", ".join(dict.fromkeys(cell.name for cell in made)) or "none (no recordings: DATA or EDGESLAM_DATA)"
        raise EvaluationError(f"no cell matches; there are: {there}")
    return [replace(cell, seed=seed) for cell in kept for seed in seeds]


def _of_recordings(data: Path | None) -> Iterator[tuple[str, Cell]]:
    """Sets and their cells."""
    for name, (place, stamps_s) in find_recordings(data, MIN_FRAMES).items() if data is not None else ():
        folder, frames = str(place), len(stamps_s)
        yield "base", Cell(name, 0, folder)
        changed = [variant for variant, change in VARIANTS.items() if change.frames_of(frames) >= MIN_FRAMES]
        segments, half = CASES[KIDNAP].get(name), CASES[SECOND_FLIGHT].get(name)
        flown = [KIDNAP] if segments and frames >= max(last for _, last in segments) else []
        flown += [SECOND_FLIGHT] if half and frames >= 2 * half else []
        for of, variants in (("variants", [*changed, BACKWARDS]), ("flights", flown)):
            for variant in variants:
                yield of, Cell(f"{name}/{variant}", 0, folder, variant)
        for kind in KINDS if name in CASES["telemetry"] else ():
            yield "telemetry", Cell(f"telemetry/{kind}/{name}", 0, folder, telemetry=kind)
        kinds = [*IMU_KINDS] if name in CASES["imu"]["recordings"] else []
        for kind in (*kinds, *([RECORDED] if name in CASES["imu"][RECORDED] else ())):
            yield "imu", Cell(f"imu/{kind}/{name}", 0, folder, imu=kind)


def _of_simulations() -> Iterator[tuple[str, Cell]]:
    """The same without recordings."""
    for course in CASES["imu"]["courses"]:
        for kind in CASES["imu"]["kinds"]:
            yield "imu", Cell(f"imu/{kind}/{course}", 0, course=course, imu=kind)
    for course in COURSES:
        yield "flights", Cell(f"flight/{course}", 0, course=course)
    for variant, courses in CASES["courses"].items():
        for course in courses:
            yield "flights", Cell(f"flight/{course}/{variant}", 0, variant=variant, course=course)
    for kind in NONE:
        yield "flights", Cell(f"none/{kind}", 0, nothing=kind)
