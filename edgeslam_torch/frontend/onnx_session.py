"""A network in onnxruntime, on the CPU."""

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.errors import WeightsError

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


def has_onnxruntime() -> bool:
    """Whether it is installed."""
    return importlib.util.find_spec("onnxruntime") is not None


def open_session(content: bytes, weights: Path, threads: int) -> "InferenceSession":
    """Load a network.

    Args:
        content: The ONNX file.
        weights: Where it comes from, for messages.
        threads: Threads of one inference.

    Raises:
        WeightsError: If onnxruntime is missing or cannot load it.
    """
    try:
        import onnxruntime
    except ImportError:
        raise WeightsError(f"{weights}: running an ONNX file needs onnxruntime (pip install onnxruntime)") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # errors are raised anyway
    try:
        return onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base class
        raise WeightsError(f"{weights}: onnxruntime cannot load it ({first_line(error)})") from error


def first_line(error: Exception) -> str:
    """An error's words on one line."""
    return " ".join(str(error).split())[:160]
