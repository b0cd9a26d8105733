"""Inputs of a fine-tuning: data, weights and settings, as a comparable record."""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import nn

from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train.views.datasets import DepthFolder
from edgeslam_torch.train.views.posed import PosedSequence

HOOKS = "hooks"
"""Setting with the names of the user's hooks."""
NOT_COMPARED = (
    *("steps", "patience", "validate_every", "checkpoint_every", "warmup_steps", HOOKS),
    *("device", "amp", "channels_last", "workers", "accumulate"),
)
"""Settings of the length of training, and of where it is computed, may differ; those of hooks that change losses are
compared."""


@dataclass(frozen=True, slots=True)
class DataSet:
    """One folder of images."""

    name: str
    kind: str
    """``depth`` (labelled), ``run`` (poses and map points)."""
    images: int | None = None
    """None, like the hash, before it is read."""
    sha256: str | None = None
    """Hash of all training inputs: images, calibration, depth or poses and map points."""


@dataclass(frozen=True, slots=True)
class Inputs:
    """Everything that determines the result."""

    weights: str
    """Name and hash of the initial weights."""
    data: tuple[DataSet, ...]
    validation: tuple[DataSet, ...]
    settings: dict[str, Any]

    def differences(self, other: "Inputs", ignored: Sequence[str] = NOT_COMPARED) -> list[str]:
        """Differences between ``other`` (now) and this (then), in words; unread inputs are not compared.

        Args:
            other: What is given now.
            ignored: Settings that may differ.
        """
        found = [] if self.weights == other.weights else [f"weights: {self.weights} then, {other.weights} now"]
        for what in ("data", "validation"):
            found += _data_differences(what, getattr(self, what), getattr(other, what))
        for name in sorted((self.settings.keys() | other.settings.keys()) - set(ignored)):
            then, now = self.settings.get(name), other.settings.get(name)
            if then != now:
                found.append(f"{name}: {_short(then)} then, {_short(now)} now")
        return found


def given_from_json(record: dict[str, Any]) -> Inputs:
    """The record that `dataclasses.asdict` and JSON made of `Inputs`.

    Raises:
        KeyError, TypeError: If it is not such a record.
    """
    sets = {what: tuple(DataSet(**entry) for entry in record[what]) for what in ("data", "validation")}
    return Inputs(str(record["weights"]), sets["data"], sets["validation"], dict(record["settings"]))


def weights_name(network: nn.Module, metadata: Metadata) -> str:
    """Variant and the first digits of a hash over all tensors and the record."""
    tensors = [value.detach().cpu().numpy() for _, value in sorted(network.state_dict().items())]
    record = json.dumps(dataclasses.asdict(metadata), sort_keys=True)
    return f"{metadata.variant} {_hash(tensors, record)[:12]}"


def labelled_set(folder: DepthFolder) -> DataSet:
    """Record of a folder with depth."""
    if folder.sha256 is not None:
        return DataSet(folder.name, "depth", len(folder.views), folder.sha256)
    arrays = (array for v in folder.views for array in (v.image, v.depth_m, v.K))
    return DataSet(folder.name, "depth", len(folder.views), _hash(arrays))


def posed_set(sequence: PosedSequence) -> DataSet:
    """Record of a run."""
    arrays = (array for v in sequence.views for array in (v.image, v.K, v.T_w_c, v.uv, v.z))
    return DataSet(sequence.name, "run", len(sequence.views), _hash(arrays, str(sequence.metric)))


def _data_differences(what: str, then: Sequence[DataSet], now: Sequence[DataSet]) -> list[str]:
    if [(d.name, d.kind) for d in then] != [(d.name, d.kind) for d in now]:
        return [f"{what}: {_names(then)} then, {_names(now)} now"]
    found = []
    for a, b in zip(then, now, strict=True):
        if None in (a.sha256, b.sha256) or a.sha256 == b.sha256:
            continue
        if a.images != b.images:
            found.append(f"{a.name}: {a.images} images then, {b.images} now")
        else:
            found.append(f"{a.name}: images, {'depth' if a.kind == 'depth' else 'poses'} or calibration have changed")
    return found


def _names(sets: Sequence[DataSet]) -> str:
    return ", ".join(f"{d.name} ({d.kind})" for d in sets) or "none"


def _short(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _hash(arrays: Iterable[np.ndarray], text: str = "") -> str:
    digest = hashlib.sha256(text.encode())
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
