"""Depth that the teacher measured, kept for other trainings on the same images."""

import hashlib
import os
import re
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.train.processes.distributed import by_first
from edgeslam_torch.train.teachers import densify, plane_sweep, teach

GB = 1_000_000_000
IN_USE_S = 7200.0
"""Entries used less than this long ago stay: another training may be reading them."""
_ENTRY = re.compile(r".+-[0-9a-f]{24}")


@dataclass(frozen=True, slots=True)
class TeacherCache:
    """A folder with one entry for each run, network and settings, named by a hash of them all."""

    path: Path
    most_bytes: int = 10 * GB
    """The entries used longest ago go when there is more."""

    def entry(self, name: str, *content: str) -> Path:
        """The folder for depth of a run, which counts as used now.

        Args:
            name: Of the run, for people.
            content: All that its depth depends on: hash of images, poses and map points; the network; the scale.

        Raises:
            ConfigError: If the folder cannot be written to.
        """
        digest = hashlib.sha256(repr((content, _settings())).encode()).hexdigest()
        entry = self.path / f"{name}-{digest[:24]}"
        by_first(lambda: self._use(entry))
        return entry

    def _use(self, entry: Path) -> None:
        try:
            entry.mkdir(parents=True, exist_ok=True)
            os.utime(entry)
        except OSError as error:
            raise ConfigError(f"--cache {self.path}: cannot be written to ({error.strerror or error})") from error

    def shrink(self, now_s: float | None = None) -> list[str]:
        """Remove the entries used longest ago until the rest fits; nothing else in the folder is touched.

        Args:
            now_s: Present time, by default the clock's.

        Returns:
            Names of what was removed.
        """
        now_s = time.time() if now_s is None else now_s
        if not self.path.is_dir():
            return []
        entries = [path for path in self.path.iterdir() if path.is_dir() and _ENTRY.fullmatch(path.name)]
        sizes = {path: sum(file.stat().st_size for file in path.iterdir()) for path in entries}
        total, removed = sum(sizes.values()), []
        for path in sorted(entries, key=lambda entry: entry.stat().st_mtime):
            if total <= self.most_bytes or now_s - path.stat().st_mtime < IN_USE_S:
                break
            shutil.rmtree(path)
            total -= sizes[path]
            removed.append(path.name)
        return removed


def _settings() -> Sequence[object]:
    """Every constant that measured depth depends on."""
    sweep = (plane_sweep.WINDOW, plane_sweep.NOISE, plane_sweep.BEST, plane_sweep.STEP_COST, plane_sweep.JUMP_COST)
    views = (teach.MOST, teach.WIDTH, teach.PLANES, teach.NEIGHBOURS, teach.NEAR, teach.FAR)
    spread = (densify.SCALES, densify.SHRINK, densify.MAX_LOG_RATIO)
    return (
        *sweep,
        plane_sweep.CONTRAST,
        *spread,
        *views,
        teach.CONFIRMING,
        teach.TOLERANCE,
        teach.ASKED,
        teach.SPACING,
    )
