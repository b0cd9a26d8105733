"""Network weights on disk: safetensors with a JSON record in the header."""

import copy
import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import safetensors.torch
import torch
from torch import Tensor, nn

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.models.fastdepth import FastDepth
from edgeslam_torch.models.layout import STEP_COUNTER, Widths
from edgeslam_torch.models.record import (
    DEFAULT_WEIGHTS,
    HEADER_KEY,
    Metadata,
    metadata_from_record,
)
from edgeslam_torch.models.torch_file import is_zip, open_checkpoint
from edgeslam_torch.models.weights_file import Array, check_weights, metadata_without_record, open_weights, read_weights

Network = TypeVar("Network", bound=nn.Module)


def build_network(metadata: Metadata, widths: Widths | None = None) -> FastDepth:
    """A newly initialised network for this description."""
    return FastDepth(metadata.variant, widths, metadata.padding, metadata.output, metadata.uncertainty)


def save_checkpoint(network: nn.Module, metadata: Metadata, path: Path, half: bool = False) -> None:
    """Write weights and metadata, atomically.

    Args:
        network: Network to store.
        metadata: Its metadata.
        path: File to write; an older one is replaced.
        half: Store float16: half the size, depth changes by less than 0.1 %.

    Raises:
        OSError: If writing fails; an older file is kept.
    """
    tensors = {k: _stored(v, half) for k, v in network.state_dict().items()}
    # A single key, because safetensors writes several in random order and equal weights should give equal bytes.
    header = {HEADER_KEY: json.dumps(dataclasses.asdict(metadata))}
    content = safetensors.torch.save(tensors, header)  # safetensors' save_file creates files with mode 0600
    write_atomically(path, lambda file: file.write(content))


def load_checkpoint(path: Path | None = None) -> tuple[FastDepth, Metadata]:
    """Network in evaluation mode and its metadata; the shipped weights when ``path`` is None.

    Also reads torch files (zip) that hold ``{"state_dict": ..., "metadata": ...}`` or a bare state_dict.

    Raises:
        WeightsError: If the file is missing, damaged, of another network, or has implausible values.
    """
    path = DEFAULT_WEIGHTS if path is None else Path(path)
    state, metadata = _read_torch(path) if _is_torch_zip(path) else read_weights(path)
    return network_of(state, metadata), metadata


def network_of(state: Mapping[str, Array], metadata: Metadata) -> FastDepth:
    """Network in evaluation mode with parameters validated by `check_weights`."""
    network = build_network(metadata, Widths.of_state_dict(state))
    counters = {k: v for k, v in network.state_dict().items() if k.endswith(STEP_COUNTER)}
    network.load_state_dict(counters | {k: torch.from_numpy(v) for k, v in state.items()})
    return network.eval()


def restored(network: Network, path: Path) -> Network:
    """A copy of a network, in evaluation mode, with the tensors that `save_checkpoint` wrote of one like it.

    Raises:
        WeightsError: If the file is missing, damaged, or of a network with other tensors.
    """
    try:
        state = safetensors.torch.load_file(path)
    except (OSError, safetensors.SafetensorError) as error:
        raise WeightsError(f"{path}: cannot read the weights ({' '.join(str(error).split())[:120]})") from error
    copied = copy.deepcopy(network)
    if {k: v.shape for k, v in state.items()} != {k: v.shape for k, v in copied.state_dict().items()}:
        raise WeightsError(f"{path}: is of another network, its tensors have other names or shapes")
    copied.load_state_dict(state)
    return copied.eval()


def file_hash(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with Path(path).open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _stored(tensor: Tensor, half: bool) -> Tensor:
    tensor = tensor.detach().cpu().contiguous().clone()
    return tensor.half() if half and tensor.is_floating_point() else tensor


def _is_torch_zip(path: Path) -> bool:
    try:
        with open_weights(path) as file:  # regular files only: a pipe never ends
            return is_zip(file)
    except (OSError, WeightsError):
        return False  # `read_weights` states the reason


def _read_torch(path: Path) -> tuple[dict[str, Array], Metadata]:
    with open_checkpoint(path) as checkpoint:
        if checkpoint.is_module:
            raise WeightsError("holds a whole pickled network; convert it first: `edgeslam weights convert`")
        record = checkpoint.record
        metadata = metadata_without_record(checkpoint.state, path) if record is None else metadata_from_record(record)
        return check_weights(checkpoint.state, metadata), metadata
