"""Conversion of upstream's checkpoints, pickles of whole modules, to plain tensors without executing them."""

from pathlib import Path

from edgeslam_torch.models.checkpoint import network_of, save_checkpoint
from edgeslam_torch.models.record import Metadata, upstream_metadata
from edgeslam_torch.models.torch_file import open_checkpoint
from edgeslam_torch.models.weights_file import Array, check_weights, metadata_without_record


def read_upstream(path: Path, official: bool = False) -> tuple[dict[str, Array], Metadata]:
    """Parameters of an official checkpoint (``checkpoint['model']``, a bare module, or a state dict) and its
    metadata; data and licence are stated only if it comes from the ``official`` address.

    Raises:
        WeightsError: If the file is damaged or holds no FastDepth.
    """
    with open_checkpoint(path) as checkpoint:
        metadata = upstream_metadata(checkpoint.state) if official else metadata_without_record(checkpoint.state, path)
        return check_weights(checkpoint.state, metadata), metadata


def convert_upstream(path: Path, out: Path, official: bool = False) -> Metadata:
    """Write a FastDepth checkpoint as safetensors with metadata; ``official`` as for `read_upstream`.

    Raises:
        WeightsError: If it is not a FastDepth checkpoint.
        OSError: If ``out`` cannot be written.
    """
    state, metadata = read_upstream(path, official)
    save_checkpoint(network_of(state, metadata), metadata, out)
    return metadata
