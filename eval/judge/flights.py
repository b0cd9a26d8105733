"""Simulated flights of the judge, each recorded once for all judges, and sources without usable images."""

import hashlib
import tempfile
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from edgeslam_torch import synthetic
from edgeslam_torch.errors import EdgeSlamError
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.judge.sources import made_of
from edgeslam_torch.readers.source import Recording
from edgeslam_torch.synthetic.flights.courses import (
    COURSES,
    RATE_HZ,
    flown,
    record_course,
    simulated_camera,
)
from edgeslam_torch.synthetic.house.render import render

NONE = ("noise", "black", "frozen")
"""Sources without usable images."""
NONE_FRAMES = 150


def flight_folder(root: Path, course: str, seed: int, flight: int = 0) -> Path:
    """Folder of a course's recording, recorded if missing; each version of the simulator has its own folder.

    Args:
        root: Folder of the recordings.
        course: A name in `COURSES`.
        seed: Seed of the world.
        flight: Number of a further flight in the same world, on another path; 0 for the course itself.

    Raises:
        EvaluationError: If it cannot be recorded.
    """
    folder = root / f"{course}-s{seed}{f'-f{flight}' if flight else ''}-{_simulator()}"
    if not folder.is_dir():
        # In a process of its own: drawing the pictures does not count as the judged run's memory.
        with ProcessPoolExecutor(1, get_context("spawn")) as other:
            try:
                other.submit(record_once, folder, course, seed, flight).result()
            except (EdgeSlamError, OSError, BrokenProcessPool) as error:
                raise EvaluationError(f"{course}, seed {seed}: could not be recorded: {error}") from error
    return folder


def nothing_to_see(kind: str, seed: int) -> Recording:
    """Images of noise, black images, or a single image repeated."""
    camera = simulated_camera()
    shape = (camera.height, camera.width, 3)
    if kind == "noise":
        return made_of(
            lambda i: np.random.default_rng([seed, i]).integers(0, 256, shape, dtype=np.uint8),
            NONE_FRAMES,
            camera,
            RATE_HZ,
        )
    picture = np.zeros(shape, np.uint8)
    if kind == "frozen":
        world, flight, _ = flown(COURSES["room"], seed, seconds=5.0)
        picture = render(world, camera, flight.T_w_c[-1]).image
    return made_of(lambda _: picture, NONE_FRAMES, camera, RATE_HZ)


@lru_cache(maxsize=1)
def _simulator() -> str:
    """Digest of the simulator's code and scenes."""
    digest = hashlib.sha256()
    for path in sorted(p for p in Path(synthetic.__file__).parent.rglob("*.*") if p.suffix in (".py", ".toml")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def record_once(folder: Path, course: str, seed: int, flight: int = 0) -> None:
    """Record into a temporary folder and rename it to ``folder`` when complete; the first of several processes wins."""
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as own:
        part = Path(own) / folder.name
        record_course(part, COURSES[course], seed, flight=flight)
        try:
            part.rename(folder)
        except OSError:
            if not folder.is_dir():  # not another judge's
                raise
