"""A network in onnxruntime."""

import importlib.util
import logging
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from edgeslam_torch.errors import ConfigError, WeightsError
from edgeslam_torch.models.device import onnx_providers

if TYPE_CHECKING:
    from onnxruntime import InferenceSession


logger = logging.getLogger(__name__)
TIMEOUT_S = 120.0
MEMORY_BYTES = 3 << 30
"""Limit of the address space without `PER_BYTE` per byte of the file; interpreter and libraries take 1.1 GB."""
PER_BYTE = 6
"""Memory per byte of the file: the file, the parsed file, the session's weights, and their packed copies."""
EXIT_REFUSED = 3
_TRIAL = "import sys; from edgeslam_torch.frontend.depth_network import trial; sys.exit(trial(sys.argv[1]))"
MAX_REASON = 2000
"""Maximum number of characters of an error message; names in a file may be as long as the file."""


def has_onnxruntime() -> bool:
    """Whether it is installed."""
    return importlib.util.find_spec("onnxruntime") is not None


def open_session(model: Path | bytes, weights: Path, threads: int, device: str = "cpu") -> "InferenceSession":
    """Load a network.

    Args:
        model: The ONNX file or its content, which the session keeps in memory.
        weights: The file that the user named, for messages.
        threads: Threads per inference.
        device: One of `edgeslam_torch.models.device.DEVICES`; ``auto`` selects CUDA if it works.

    Raises:
        ConfigError: If an explicitly named device is not available.
        WeightsError: If onnxruntime is missing or cannot load it.
    """
    try:
        import onnxruntime
    except ImportError:
        raise WeightsError(f"{weights}: running an ONNX file needs onnxruntime (pip install onnxruntime)") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # errors are raised as exceptions
    wanted = onnx_providers(device)
    try:
        session = onnxruntime.InferenceSession(model, options, providers=wanted)
    except Exception as error:  # onnxruntime's errors have no common base class
        raise WeightsError(f"{weights}: onnxruntime cannot load it ({first_line(error)})") from error
    # onnxruntime silently falls back to the next provider if libraries or the GPU are missing.
    if session.get_providers()[0] != wanted[0]:
        if device == "cuda":
            raise ConfigError("--device cuda: onnxruntime cannot use CUDA here (driver or libraries); use --device cpu")
        logger.warning("onnxruntime cannot use CUDA here (driver or libraries): depth runs on the processor")
    return session


def try_apart(path: Path) -> None:
    """Open a network and run it on small images in a subprocess with limits on time and memory, since a small file may
    request gigabytes or an endless loop.

    Raises:
        WeightsError: If it fails or exceeds the limits; with the message of `open_depth` if there is one.
    """
    command = [sys.executable, "-c", _TRIAL, str(path)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL)
    except subprocess.TimeoutExpired:
        raise WeightsError(f"{path}: refused: it did not run on a small image within {TIMEOUT_S:.0f} s") from None
    if done.returncode == EXIT_REFUSED:
        raise WeightsError(done.stdout.strip())
    if done.returncode:
        raise WeightsError(
            f"{path}: refused: it crashes, or takes more than {MEMORY_BYTES >> 30} GiB for a small image"
        )


def bound_memory(path: Path) -> None:
    """Limit this process's memory to the maximum for a network file, where the system supports it."""
    try:
        import resource
    except ImportError:  # Windows
        return
    try:
        bound = MEMORY_BYTES + PER_BYTE * path.stat().st_size
        resource.setrlimit(resource.RLIMIT_AS, (bound, bound))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    except (OSError, ValueError):  # no file, a lower limit is set, or the system supports none
        return


def device_of(session: "InferenceSession") -> str:
    """``cpu`` or ``cuda``."""
    return "cuda" if session.get_providers()[0] == "CUDAExecutionProvider" else "cpu"


def words_of(runtime: str, device: str) -> str:
    """Runtime and device of a network as shown to the user; the CPU is omitted."""
    return runtime if device == "cpu" else f"{runtime} on {device}"


def first_line(error: Exception) -> str:
    """First line of an error message."""
    return " ".join(str(error).split())[:MAX_REASON]
