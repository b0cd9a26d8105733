"""Result of a training."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.validate import DepthScores


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

    def to_json(self) -> dict[str, Any]:
        """Plain values, without the place of the file."""
        record = dataclasses.asdict(self)
        del record["weights"], record["nothing_to_do"]
        return record

    @staticmethod
    def from_json(record: dict[str, Any], weights: Path) -> "TrainingResult":
        """Inverse of `to_json`.

        Raises:
            KeyError, TypeError: If the record is another one.
        """
        before, last, kept = (record[k] and DepthScores(**record[k]) for k in ("before", "last", "kept"))
        return TrainingResult(weights, record["steps"], record["kept_step"], before, last, kept)

    def describe(self) -> str:
        """A short table, and which weights were kept."""
        done = "nothing was left to train: " if self.nothing_to_do else ""
        if self.before is None or self.last is None or self.kept is None:
            return f"{done}{self.weights}: {self._words()}"
        rows = [("before", self.before), (f"after {self.steps} steps", self.last)]
        if self.kept_step not in (0, self.steps):
            rows.append((f"kept, step {self.kept_step}", self.kept))
        table = ["| | AbsRel | AbsRel, median scaled | delta1 |", "|---|---|---|---|"]
        table += [f"| {name} | {s.abs_rel:.4f} | {s.abs_rel_scaled:.4f} | {s.delta1:.4f} |" for name, s in rows]
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
