"""``python -m edgeslam_torch.eval.judge.flights COURSE SEED FOLDER``: record a simulated flight, once for all judges.

A process of its own, so that drawing the pictures does not count as the judged run's memory.
"""

import hashlib
import shutil
import subprocess
import sys
from functools import lru_cache
from pathlib import Path

import numpy as np

from edgeslam_torch import synthetic
from edgeslam_torch.eval.errors import EvaluationError
from edgeslam_torch.eval.judge.sources import made_of
from edgeslam_torch.readers.source import Recording
from edgeslam_torch.synthetic.flights.courses import COURSES, RATE_HZ, flown, record_course, simulated_camera
from edgeslam_torch.synthetic.house.render import render

NONE = ("noise", "black", "frozen")
"""Sources that show nothing to make a map of."""
NONE_FRAMES = 150


def flight_folder(root: Path, course: str, seed: int) -> Path:
    """Folder of a course's recording, made when it is not there; another simulator has another folder.

    Raises:
        EvaluationError: If it cannot be recorded.
    """
    folder = root / f"{course}-s{seed}-{_simulator()}"
    if not folder.is_dir():
        command = [sys.executable, "-m", "edgeslam_torch.eval.judge.flights", course, str(seed), str(folder)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise EvaluationError(f"{course}, seed {seed}: could not be recorded: {done.stderr.strip()[-300:]}")
    return folder


def nothing_to_see(kind: str, seed: int) -> Recording:
    """Images of noise, black ones, or one picture of a room again and again."""
    camera = simulated_camera()
    shape = (camera.height, camera.width, 3)
    if kind == "noise":
        return made_of(lambda i: _noise([seed, i], shape), NONE_FRAMES, camera, RATE_HZ)
    if kind == "black":
        return made_of(lambda _: np.zeros(shape, np.uint8), NONE_FRAMES, camera, RATE_HZ)
    world, flight, _ = flown(COURSES["room"], seed, seconds=5.0)
    picture = render(world, camera, flight.T_w_c[-1]).image
    return made_of(lambda _: picture, NONE_FRAMES, camera, RATE_HZ)


def _noise(seed: list[int], shape: tuple[int, ...]) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


@lru_cache(maxsize=1)
def _simulator() -> str:
    """Digest of the simulator's code."""
    digest = hashlib.sha256()
    for path in sorted(Path(synthetic.__file__).parent.rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:8]


def main(course: str, seed: int, folder: Path) -> int:
    """Record into a folder beside ``folder`` and give it its name when it is whole."""
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    record_course(part, COURSES[course], seed)
    part.rename(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])))
