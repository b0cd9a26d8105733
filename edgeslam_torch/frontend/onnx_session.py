"""A network in onnxruntime."""

import importlib.util
import logging
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.errors import ConfigError, WeightsError
from edgeslam_torch.models.device import onnx_providers

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


logger = logging.getLogger(__name__)


def has_onnxruntime() -> bool:
    """Whether it is installed."""
    return importlib.util.find_spec("onnxruntime") is not None


def open_session(content: bytes, weights: Path, threads: int, device: str = "cpu") -> "InferenceSession":
    """Load a network.

    Args:
        content: The ONNX file.
        weights: Where it comes from, for messages.
        threads: Threads of one inference.
        device: One of `edgeslam_torch.models.device.DEVICES`; ``auto`` takes CUDA where it works.

    Raises:
        ConfigError: If the device is asked for by name, and is not there.
        WeightsError: If onnxruntime is missing or cannot load it.
    """
    try:
        import onnxruntime
    except ImportError:
        raise WeightsError(f"{weights}: running an ONNX file needs onnxruntime (pip install onnxruntime)") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # errors are raised anyway
    wanted = onnx_providers(device)
    try:
        session = onnxruntime.InferenceSession(content, options, providers=wanted)
    except Exception as error:  # onnxruntime's errors have no common base class
        raise WeightsError(f"{weights}: onnxruntime cannot load it ({first_line(error)})") from error
    # It goes on with the next provider, silently, where libraries or the card are missing.
    if session.get_providers()[0] != wanted[0]:
        if device == "cuda":
            raise ConfigError("--device cuda: onnxruntime cannot use CUDA here (driver or libraries); use --device cpu")
        logger.warning("onnxruntime cannot use CUDA here (driver or libraries): depth runs on the processor")
    return session


def device_of(session: "InferenceSession") -> str:
    """``cpu`` or ``cuda``."""
    return "cuda" if session.get_providers()[0] == "CUDAExecutionProvider" else "cpu"


def words_of(runtime: str, device: str) -> str:
    """What runs a network, for people: the processor is not worth a word."""
    return runtime if device == "cpu" else f"{runtime} on {device}"


def first_line(error: Exception) -> str:
    """An error's words on one line."""
    return " ".join(str(error).split())[:160]
