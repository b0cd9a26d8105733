"""The output folder of a fine-tuning, and whether training may resume in it.

``finetune.json`` records the inputs of its tensors. Training resumes only with the same inputs.
"""

import dataclasses
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Any

from edgeslam_torch import __version__
from edgeslam_torch.errors import ConfigError, OutputError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.train.inputs import NOT_COMPARED, Inputs, given_from_json
from edgeslam_torch.train.loop import BEST, CURVE, FINAL, LAST
from edgeslam_torch.train.processes.distributed import by_first, rank, world
from edgeslam_torch.train.result import TrainingResult
from edgeslam_torch.train.state import saved_step
from edgeslam_torch.writers.own_folder import FolderLock, check_free

RECORD, WEIGHTS = "finetune.json", "weights.safetensors"
TENSORBOARD, TEACHER = "tensorboard", "teacher"
FILES = (LAST, BEST, FINAL, WEIGHTS, CURVE, TENSORBOARD, TEACHER)
"""Files of training beside the record."""
WITH_RESUME = (*NOT_COMPARED, "lr", "encoder_lr")
"""Settings that may differ with ``--resume``: after a divergence, training continues at a smaller rate."""


class Existing(StrEnum):
    """What to do with an existing fine-tuning."""

    SAME = "same"
    """Resume if the inputs are the same, else refuse."""
    RESUME = "resume"
    """Resume, also at another learning rate; refuse if there is none."""
    OVERWRITE = "overwrite"
    """Replace it, once the data is read."""


class OutFolder:
    """Folder of a fine-tuning; only the first process of a group writes.

    Args:
        path: The folder, which exists.
        existing: What to do with an older fine-tuning.
    """

    def __init__(self, path: Path, existing: Existing = Existing.SAME) -> None:
        self.path, self.existing = path, existing

    @property
    def step(self) -> int:
        """Number of saved steps."""
        return saved_step(self.path / LAST)

    def holds(self, file: Path) -> bool:
        """Whether training here writes this file."""
        return any((self.path / name).is_file() and file.samefile(self.path / name) for name in FILES)

    def check(self, given: Inputs) -> None:
        """Check whether training with ``given`` may begin or resume here; writes nothing.

        Raises:
            ConfigError: If the folder holds another training, or none where one is to be resumed.
            OutputError: If it holds files that no fine-tuning wrote.
        """
        record = self._record()
        if record is None:
            strange = next((name for name in FILES if (self.path / name).exists()), None)
            if strange is not None:
                raise OutputError(
                    f"{self.path}: holds {strange}, but no {RECORD} that states its origin; give another --out"
                )
            check_free(self.path, ())
            if self.existing is Existing.RESUME:
                raise ConfigError(f"{self.path}: nothing to resume there")
            return
        if self.existing is Existing.OVERWRITE or not (step := self.step):
            return
        steps = given.settings["steps"]
        if step > steps:
            raise ConfigError(f"{self.path}: has {step} steps already, so it cannot end after {steps}")
        ignored = WITH_RESUME if self.existing is Existing.RESUME else NOT_COMPARED
        different = given_from_json(record["given"]).differences(given, ignored)
        if different:
            only_rate = not given_from_json(record["given"]).differences(given, WITH_RESUME)
            way_out = "--resume to continue with it" if only_rate else "--overwrite to replace it"
            raise ConfigError(
                f"{self.path}: holds another fine-tuning ({'; '.join(different)}); give another --out, or {way_out}"
            )

    def begin(self, given: Inputs) -> int:
        """Record the inputs, and remove files of other trainings.

        Returns:
            The step to resume from, 0 for a new training.

        Raises:
            ConfigError, OutputError: As for `check`.
            OSError: If the file cannot be written.
        """
        self.check(given)
        record = self._record()
        kept = record is not None and self.existing is not Existing.OVERWRITE
        if kept and record is not None and not self.step:  # interrupted early: the teacher's depth may exist
            kept = not given_from_json(record["given"]).differences(given, WITH_RESUME)
        if not kept:
            self._clear()
        step = self.step
        session = {"from_step": step, "processes": world(), "version": __version__}
        session |= {name: given.settings[name] for name in WITH_RESUME if name in given.settings}
        sessions = [*record["sessions"], session] if kept and record is not None else [session]
        self._write({"given": dataclasses.asdict(given), "sessions": sessions, "outcome": None})
        return step

    def finished(self, given: Inputs) -> TrainingResult | None:
        """Result of an identical earlier training, if any."""
        record = self._record()
        if record is None or record["outcome"] is None or self.existing is Existing.OVERWRITE:
            return None
        if not (self.path / WEIGHTS).is_file():
            return None
        if given_from_json(record["given"]).differences(given, ()):
            return None
        return TrainingResult.from_json(record["outcome"], self.path / WEIGHTS)

    def finish(self, outcome: TrainingResult) -> None:
        """Record the outcome.

        Raises:
            OSError: If the file cannot be written.
        """
        self._write({**(self._record() or {}), "outcome": outcome.to_json()})

    def _clear(self) -> None:
        """The record is kept until rewritten: it marks the folder as ours."""
        for name in FILES:
            path = self.path / name
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)

    def _write(self, record: dict[str, Any]) -> None:
        write_text(self.path / RECORD, json.dumps(record, indent=2) + "\n")

    def _record(self) -> dict[str, Any] | None:
        path = self.path / RECORD
        if not path.is_file():
            return None
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            given_from_json(record["given"])
            if record["outcome"] is not None:
                TrainingResult.from_json(record["outcome"], self.path / WEIGHTS)
            return {"given": record["given"], "sessions": list(record["sessions"]), "outcome": record["outcome"]}
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise OutputError(f"{path}: unreadable ({type(error).__name__}); give another --out") from error


@contextmanager
def out_folder(path: Path, existing: Existing = Existing.SAME) -> Iterator[OutFolder]:
    """Create and lock a folder for fine-tuning, with one-line errors.

    Raises:
        OutputError: If it cannot be written to, or another process writes there.
    """
    held: list[FolderLock] = []
    try:
        made = not path.exists()
        by_first(lambda: held.append(_locked(path)))
        try:
            yield OutFolder(path, existing)
        finally:
            for lock in held:
                lock.release()
            if made and rank() == 0 and not any(path.iterdir()):
                path.rmdir()
    except OSError as error:
        raise OutputError(f"{error.filename or path}: {error.strerror or error}") from error


def _locked(path: Path) -> FolderLock:
    path.mkdir(parents=True, exist_ok=True)
    return FolderLock(path)
