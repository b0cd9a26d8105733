"""The folder of a batch: a run folder for every finished flight, and beside them what each had to do and how it went.

``flights/NAME`` appears when the flight is finished, whole; ``jobs/NAME`` has its task, log and result, also of those
that failed; ``work/NAME`` is a flight on its way, ``older/NAME`` one of other settings.
"""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgeslam_torch import __version__
from edgeslam_torch.config import SlamConfig
from edgeslam_torch.errors import ConfigError, OutputError
from edgeslam_torch.eval.experiment.runner import Task
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.files.config_file import load_config, to_toml
from edgeslam_torch.files.plain import subfolder
from edgeslam_torch.files.record_files import is_record
from edgeslam_torch.files.signature import signature
from edgeslam_torch.fleet.manifest import Flight

FLIGHTS, JOBS, WORK, OLDER, PICTURES = "flights", "jobs", "work", "older", "pictures"
TABLE, RECORD, PAGE = "batch.csv", "batch.json", "index.html"


@dataclass(frozen=True, slots=True)
class BatchSettings:
    """How every flight of a batch is run."""

    config: SlamConfig
    max_frames: int | None = None
    map_score: bool = False
    """Compare maps with measured depth where a recording has it: half a minute and a gigabyte each."""


@dataclass(frozen=True, slots=True)
class FlightTask(Task):
    """A flight's case; its result counts while the finished run is there."""

    def finished(self) -> Path:
        """Folder of the finished run."""
        return self.place.parent / FLIGHTS / self.name

    def result(self) -> dict[str, Any] | None:
        """The result of this very case from before, if the flight finished."""
        return Task.result(self) if self.finished().is_dir() else None

    def prepare(self) -> Path:
        """The folder of a case to be run now; results of other settings move to ``older``."""
        batch = self.place.parent
        (batch / PICTURES / f"{self.name}.jpg").unlink(missing_ok=True)
        if self.finished().is_dir():
            older = subfolder(batch, OLDER) / self.name
            shutil.rmtree(older, ignore_errors=True)
            self.finished().rename(older)
        return Task.prepare(self)


class BatchFolder:
    """Paths and contents of a batch's folder."""

    def __init__(self, path: Path) -> None:
        """Make it, or go on in one.

        Raises:
            OutputError: If it holds something that no batch wrote.
            OSError: If it cannot be made.
        """
        self.path = path.resolve()
        self.path.mkdir(parents=True, exist_ok=True)
        names = {p.name for p in self.path.iterdir() if not p.name.startswith(".")}
        if names and not _is_batch(self.path):
            raise OutputError(f"{path}: holds {min(names)}, which no batch wrote; give another folder to --out")
        for name in (FLIGHTS, JOBS, WORK, PICTURES):
            subfolder(self.path, name)
        if not names:
            write_text(self.path / RECORD, "{}\n")

    def task(self, flight: Flight, settings: BatchSettings) -> FlightTask:
        """What has to be done for a flight: its recording, camera, telemetry and truth, the settings and our version.

        Raises:
            ConfigError: If its settings are malformed; the message names the manifest's line.
        """
        try:
            config = load_config(settings.config, None, flight.settings)
        except ConfigError as error:
            raise ConfigError(f"{flight.origin}: {error}") from error
        files = {name: getattr(flight, name) for name in ("camera", "telemetry", "truth")} | {
            "recording": str(flight.recording.absolute()),
            "weights": str(config.depth.weights or ""),
        }
        case = {
            "version": __version__,
            "name": flight.name,
            "batch": str(self.path),
            **files,
            "topics": list(flight.topics),
            "max_frames": settings.max_frames,
            "map_score": settings.map_score,
            "signatures": {name: self._signature(Path(file)) for name, file in files.items() if file},
            "config": to_toml(config),
        }
        return FlightTask(self.path / JOBS, flight.name, "edgeslam_torch.fleet.run_flight:run_flight", case)

    def _signature(self, path: Path) -> str:
        try:
            return signature(path, self.path)
        except OSError:
            return ""  # a preset's name, or a file that is not there, which the flight's own process reports


def finished_flights(path: Path) -> list[Path] | None:
    """Runs of a batch, by its folder or the ``flights`` in it, sorted by name; None if it is no batch's."""
    if path.name == FLIGHTS and _is_batch(path.parent):
        path = path.parent
    return sorted(run for run in (path / FLIGHTS).iterdir() if run.is_dir()) if _is_batch(path) else None


def is_beside_flights(path: Path) -> bool:
    """Whether a batch wrote it beside its ``flights``: what a shell's ``DIR/*`` names too, and no run."""
    return path.name in (JOBS, WORK, OLDER, PICTURES, TABLE, RECORD, PAGE) and _is_batch(path.parent)


def _is_batch(folder: Path) -> bool:
    return is_record(folder / RECORD, ()) and (folder / FLIGHTS).is_dir()
