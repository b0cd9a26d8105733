"""The output folder of a fine-tuning: its result, and whether training may resume in it.

``finetune.json`` records what the tensors were made from, and the outcome. Training resumes only from the same inputs.
"""

import dataclasses
import hashlib
import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from torch import nn

from edgeslam_torch import __version__
from edgeslam_torch.errors import ConfigError, OutputError
from edgeslam_torch.files.atomic import write_text
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.loop import BEST, CURVE, FINAL, LAST
from edgeslam_torch.train.processes.distributed import by_first, rank, world
from edgeslam_torch.train.state import saved_step
from edgeslam_torch.train.validate import DepthScores
from edgeslam_torch.train.views.datasets import DepthFolder
from edgeslam_torch.train.views.posed import PosedSequence
from edgeslam_torch.writers.own_folder import FolderLock, check_free


@dataclass(frozen=True, slots=True)
class TrainingResult:
    """Scores are on the validation views; None when there are none."""

    weights: Path
    """The file that was written."""
    steps: int
    kept_step: int | None = None
    """Step at which the kept weights were validated; 0 for the initial weights."""
    before: DepthScores | None = None
    last: DepthScores | None = None
    kept: DepthScores | None = None
    nothing_to_do: bool = False
    """Whether an earlier call had completed it."""

    def describe(self) -> str:
        """A short table, and which weights were kept."""
        rows = {"before": self.before, f"after {self.steps} steps": self.last}
        if self.kept_step not in (0, self.steps):
            rows[f"kept, step {self.kept_step}"] = self.kept
        table = [
            f"| {name} | {s.abs_rel:.4f} | {s.abs_rel_scaled:.4f} | {s.delta1:.4f} |" for name, s in rows.items() if s
        ]
        if table:
            table = ["| | AbsRel | AbsRel, median scaled | delta1 |", "|---|---|---|---|", *table]
        done = "nothing was left to train: " if self.nothing_to_do else ""
        return "\n".join([*table, f"{done}{self.weights}: {self._words()}"])

    def warnings(self) -> list[str]:
        """Warnings about the outcome."""
        if self.before is None or self.last is None or self.kept is None:
            return []
        change = f"median-scaled AbsRel {self.before.abs_rel_scaled:.4f} before, {self.last.abs_rel_scaled:.4f} after"
        if self.kept_step == 0:
            return [f"fine-tuning improved nothing ({change}); the weights it began with are kept"]
        found = []
        if self.last.abs_rel_scaled > self.before.abs_rel_scaled:
            found.append(f"in the end fine-tuning made depth worse ({change}); step {self.kept_step} is kept")
        if self.kept.abs_rel > self.before.abs_rel:
            change = f"AbsRel {self.before.abs_rel:.4f} before, {self.kept.abs_rel:.4f} now"
            found.append(f"shapes became better, metres worse ({change})")
        return found

    def noted_in(self, metadata: Metadata) -> Metadata:
        """Metadata of the kept weights, with the outcome in its notes."""
        notes = [metadata.notes] if self.kept_step == 0 and metadata.notes else ["edgeslam finetune"]
        return dataclasses.replace(metadata, notes="; ".join([*notes, self._words(), *self.warnings()]))

    def _words(self) -> str:
        if self.kept_step is None:
            return f"weights after {self.steps} steps, not validated: there was no depth to compare with"
        if self.kept_step == 0:
            return "the weights that fine-tuning began with, unchanged"
        return f"weights after step {self.kept_step} of {self.steps}, the best validated"


RECORD, WEIGHTS = "finetune.json", "weights.safetensors"
TENSORBOARD, TEACHER = "tensorboard", "teacher"
FILES = (LAST, BEST, FINAL, WEIGHTS, CURVE, TENSORBOARD, TEACHER)
"""Files of training beside the record."""
HOOKS = "hooks"
"""Setting with the names of the user's hooks."""
NOT_COMPARED = (
    *("steps", "patience", "validate_every", "checkpoint_every", "warmup_steps", HOOKS),
    *("device", "amp", "channels_last", "workers", "accumulate"),
)
"""Settings of the length of training, and of where it is computed, may differ; those of hooks that change losses are
compared."""
WITH_RESUME = (*NOT_COMPARED, "lr", "encoder_lr")
"""Settings that may differ with ``--resume``: after a divergence, training continues at a smaller rate."""
_CONTENT = "images of "


class Existing(StrEnum):
    """What to do with an existing fine-tuning."""

    SAME = "same"
    """Resume if the inputs are the same, else refuse."""
    RESUME = "resume"
    """Resume, also at another learning rate; refuse if there is none."""
    OVERWRITE = "overwrite"
    """Replace it, once the data is read."""


def inputs(
    start: tuple[nn.Module, Metadata],
    data: Sequence[tuple[str, str]],
    validation: Sequence[str],
    settings: Mapping[str, Any],
) -> dict[str, Any]:
    """What determines the result, by name, before anything is read; with `contents`, all of it.

    ``data`` has name and kind of each set: ``depth`` (labelled) or ``run`` (poses and map points).
    """
    named = ", ".join(f"{name} ({kind})" for name, kind in data)
    return {"weights": weights_name(*start), "data": named, "validation": ", ".join(validation) or "none", **settings}


def contents(sets: Iterable[DepthFolder | PosedSequence]) -> dict[str, Any]:
    """What was read, to be added to the inputs."""
    found: dict[str, Any] = {}
    for one in sets:
        found[_CONTENT + one.name] = found.get(_CONTENT + one.name, "") + content(one)
    return found


def content(data: DepthFolder | PosedSequence) -> str:
    """Number of images, and a hash of all that is learnt from: images, calibration, depth or poses and map points."""
    if isinstance(data, PosedSequence):
        arrays = [array for v in data.views for array in (v.image, v.K, v.T_w_c, v.uv, v.z)]
        return f"{len(data.views)}, {_hash(arrays, str(data.metric))}"
    digest = data.sha256 or _hash(array for v in data.views for array in (v.image, v.depth_m, v.K))
    return f"{len(data.views)}, {digest}"


def weights_name(network: nn.Module, metadata: Metadata) -> str:
    """Variant and the first digits of a hash over all tensors and the record."""
    tensors = [value.detach().cpu().numpy() for _, value in sorted(network.state_dict().items())]
    record = json.dumps(dataclasses.asdict(metadata), sort_keys=True)
    return f"{metadata.variant} {_hash(tensors, record)[:12]}"


def _hash(arrays: Iterable[np.ndarray], text: str = "") -> str:
    digest = hashlib.sha256(text.encode())
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


def _differences(then: dict[str, Any], now: dict[str, Any], ignored: Sequence[str] = ()) -> list[str]:
    """What differs, in words, but for some settings; data that was not read yet is not compared."""
    unread = {name for name in then.keys() ^ now.keys() if name.startswith(_CONTENT)}
    names = sorted((then.keys() | now.keys()) - {*ignored, *unread})
    return [f"{k}: {_short(then.get(k))} then, {_short(now.get(k))} now" for k in names if then.get(k) != now.get(k)]


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)[:120]


class OutFolder:
    """Folder of a fine-tuning; only the first process of a group writes."""

    def __init__(self, path: Path, existing: Existing = Existing.SAME) -> None:
        self.path, self.existing = path, existing

    @property
    def step(self) -> int:
        """Number of saved steps."""
        return saved_step(self.path / LAST)

    def holds(self, file: Path) -> bool:
        """Whether training here writes this file."""
        return any((self.path / name).is_file() and file.samefile(self.path / name) for name in FILES)

    def check(self, given: dict[str, Any]) -> None:
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
        if step > given["steps"]:
            raise ConfigError(f"{self.path}: has {step} steps already, so it cannot end after {given['steps']}")
        resumed = self.existing is Existing.RESUME
        if different := _differences(record["given"], given, WITH_RESUME if resumed else NOT_COMPARED):
            only_rate = not _differences(record["given"], given, WITH_RESUME)
            way_out = "--resume to continue with it" if only_rate else "--overwrite to replace it"
            raise ConfigError(
                f"{self.path}: holds another fine-tuning ({'; '.join(different)}); give another --out, or {way_out}"
            )

    def begin(self, given: dict[str, Any]) -> None:
        """Record the inputs, and remove files of other trainings."""
        self.check(given)
        record = self._record() if self.existing is not Existing.OVERWRITE else None
        # One that was interrupted before the first step may have left its teacher's depth.
        if record is None or (not self.step and _differences(record["given"], given, WITH_RESUME)):
            for path in (self.path / name for name in FILES):
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink(missing_ok=True)
            record = {"sessions": []}
        session = {"from_step": self.step, "processes": world(), "version": __version__}
        session |= {name: given[name] for name in WITH_RESUME if name in given}
        self._write({"given": given, "sessions": [*record["sessions"], session], "outcome": None})

    def finished(self, given: dict[str, Any]) -> TrainingResult | None:
        """Result of an identical earlier training, if any."""
        record, weights = self._record(), self.path / WEIGHTS
        if record is None or record["outcome"] is None or self.existing is Existing.OVERWRITE or not weights.is_file():
            return None
        return None if _differences(record["given"], given) else _outcome(record["outcome"], weights)

    def finish(self, outcome: TrainingResult) -> None:
        """Record the outcome."""
        kept = {k: v for k, v in dataclasses.asdict(outcome).items() if k not in ("weights", "nothing_to_do")}
        self._write({**(self._record() or {}), "outcome": kept})

    def _write(self, record: dict[str, Any]) -> None:
        write_text(self.path / RECORD, json.dumps(record, indent=2) + "\n")

    def _record(self) -> dict[str, Any] | None:
        path = self.path / RECORD
        if not path.is_file():
            return None
        try:
            record = json.loads(path.read_text(encoding="utf-8"))
            if record["outcome"] is not None:
                _outcome(record["outcome"], path)
            return {"given": dict(record["given"]), "sessions": list(record["sessions"]), "outcome": record["outcome"]}
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise OutputError(f"{path}: unreadable ({type(error).__name__}); give another --out") from error


def _outcome(record: dict[str, Any], weights: Path) -> TrainingResult:
    """From the plain values of `OutFolder.finish`."""
    before, last, kept = (record[k] and DepthScores(**record[k]) for k in ("before", "last", "kept"))
    return TrainingResult(weights, record["steps"], record["kept_step"], before, last, kept)


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
