"""The shipped networks as ONNX files in the user's cache: made once, so that later runs start without ``onnx``."""

import hashlib
from pathlib import Path

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.files.atomic import write_atomically
from edgeslam_torch.files.user_cache import cache_folder
from edgeslam_torch.models.record import SHIPPED_WEIGHTS, Metadata
from edgeslam_torch.models.weights_file import read_header


def cached_graph(weights: Path) -> tuple[Path | bytes, Metadata]:
    """ONNX model and record of a safetensors file: a file in the cache, or its bytes.

    Weights of the user's own are not cached: every fine-tuning would leave 16 MB.

    Raises:
        WeightsError: As of `build_graph`.
    """
    if weights not in SHIPPED_WEIGHTS.values():
        return _built(weights)
    try:
        made_of = weights.read_bytes() + Path(__file__).with_name("graph.py").read_bytes()
        file = cache_folder() / f"{weights.stem}-{hashlib.blake2b(made_of, digest_size=16).hexdigest()}.onnx"
        metadata = read_header(weights)
        if not file.is_file():
            file.parent.mkdir(parents=True, exist_ok=True)
            content, _ = _built(weights)
            write_atomically(file, lambda out: out.write(content))
        return file, metadata
    except (OSError, WeightsError):  # a cache that cannot be written; damaged weights, which the builder reports
        return _built(weights)


def _built(weights: Path) -> tuple[bytes, Metadata]:
    from edgeslam_torch.models.onnx.graph import build_graph

    return build_graph(weights)
