"""Network weights on disk: safetensors with a JSON record in the header."""

import dataclasses
import hashlib
import json
import pickle
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor

from edgeslam_torch.atomic import write_atomically
from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.fastdepth import FastDepth, Output, Variant, Widths
from edgeslam_torch.models.mobilenet import Padding
from edgeslam_torch.models.record import DEFAULT_WEIGHTS, HEADER_KEY, Metadata, metadata_from_json


def build_network(metadata: Metadata, widths: Widths | None = None) -> FastDepth:
    """A network of this description with fresh weights."""
    return FastDepth(metadata.variant, widths, metadata.padding, metadata.output, metadata.uncertainty)


def save_checkpoint(network: FastDepth, metadata: Metadata, path: Path, half: bool = False) -> None:
    """Write weights and metadata, atomically.

    Args:
        network: What to store.
        metadata: Its record.
        path: File to write; an older one is replaced.
        half: Store float16: half the size, depth changes by less than 0.1 %.

    Raises:
        OSError: If the disk refuses; an older file is then still there.
    """
    tensors = {k: _stored(v, half) for k, v in network.state_dict().items()}
    # One key only: safetensors writes several in random order, and the same weights should be the same bytes.
    header = {HEADER_KEY: json.dumps(dataclasses.asdict(metadata))}
    content = safetensors.torch.save(tensors, header)  # its own save_file makes files that only their owner can read
    write_atomically(path, lambda file: file.write(content))


def load_checkpoint(path: Path | None = None) -> tuple[FastDepth, Metadata]:
    """Network in evaluation mode and its metadata; the shipped weights when ``path`` is None.

    Also reads ``weights_only`` torch files that hold ``{"state_dict": ..., "metadata": ...}`` or a bare
    state_dict.

    Raises:
        WeightsError: If the file is missing, damaged or of another network.
    """
    path = DEFAULT_WEIGHTS if path is None else Path(path)
    if not path.is_file():
        raise WeightsError(f"{path}: no such weights file; `edgeslam weights list` shows what can be downloaded")
    state, metadata = _read(path)
    network = build_network(metadata, Widths.of_state_dict(state))
    try:
        network.load_state_dict({k: v.float() if v.is_floating_point() else v for k, v in state.items()})
    except RuntimeError as error:
        raise WeightsError(f"{path}: does not fit {metadata.variant} ({' '.join(str(error).split())[:200]})") from None
    return network.eval(), metadata


def read_metadata(path: Path) -> Metadata:
    """The record in the header alone."""
    return _read(Path(path))[1]


def file_hash(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    digest = hashlib.sha256()
    with Path(path).open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def upstream_metadata(state: dict[str, Tensor]) -> Metadata:
    """What an official checkpoint without a record is: NYU Depth v2, 224x224, RGB in [0, 1], depth in metres.

    The focal length is that of NYU's Kinect (518.86 px at 640) in upstream's preprocessing: 640x480 scaled
    to height
    250, centre-cropped to 304x228, then squeezed to 224x224.
    """
    widths = Widths.of_state_dict(state)
    skips = "conv0.0.weight" in state
    if not skips:
        variant = Variant.NNCONV5DW if "decoder.conv1.1.0.weight" in state else Variant.NNCONV5
    else:
        variant = Variant.SKIPADD if widths.encoder[-1] == 1024 else Variant.PRUNED
    return Metadata(
        variant=variant.value,
        input_height=224,
        input_width=224,
        focal_px=518.86 * 250 / 480 * 224 / 304,
        mean=(0.0, 0.0, 0.0),
        std=(1.0, 1.0, 1.0),
        padding=Padding.SYMMETRIC.value,
        output=Output.DEPTH.value,
        uncertainty=False,
        sigma_floor=0.25,
        data=("NYU Depth v2",),
        licence="MIT (dwofk/fast-depth)",
    )


def _stored(tensor: Tensor, half: bool) -> Tensor:
    tensor = tensor.detach().cpu().contiguous().clone()
    return tensor.half() if half and tensor.is_floating_point() else tensor


def _read(path: Path) -> tuple[dict[str, Tensor], Metadata]:
    try:
        with path.open("rb") as file:
            is_zip = file.read(2) == b"PK"
        if is_zip:
            return _read_torch(path)
        with safetensors.safe_open(path, framework="pt") as opened:
            header = opened.metadata() or {}
            state = {key: opened.get_tensor(key) for key in opened.keys()}  # noqa: SIM118 - not a mapping
    except (OSError, safetensors.SafetensorError) as error:
        raise WeightsError(f"{path}: damaged or not a safetensors file ({error})") from error
    try:
        metadata = metadata_from_json(header[HEADER_KEY]) if HEADER_KEY in header else upstream_metadata(state)
    except (json.JSONDecodeError, TypeError) as error:
        raise WeightsError(f"{path}: unreadable metadata in the header ({error})") from error
    return state, metadata


def _read_torch(path: Path) -> tuple[dict[str, Tensor], Metadata]:
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, ValueError, ModuleNotFoundError) as error:
        raise WeightsError(f"{path}: damaged torch file ({' '.join(str(error).split())[:160]})") from error
    except pickle.UnpicklingError:
        raise WeightsError(
            f"{path}: holds pickled code, not plain tensors; convert it first: `edgeslam weights convert`"
        ) from None
    if not isinstance(content, dict):
        raise WeightsError(f"{path}: holds no state_dict")
    state = content.get("state_dict", content)
    record = content.get("metadata") if "state_dict" in content else None
    return state, metadata_from_json(json.dumps(record)) if record else upstream_metadata(state)
