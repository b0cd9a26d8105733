"""Where a network runs; importing this needs no torch."""

import importlib.util
import os
from typing import TYPE_CHECKING

from edgeslam_torch.errors import ConfigError

if TYPE_CHECKING:
    import torch

DEVICES = ("auto", "cpu", "cuda", "mps")


def check_device(name: str) -> None:
    """Refuse a name that is none."""
    if name not in DEVICES:
        raise ConfigError(f"--device {name}: there are {', '.join(DEVICES)}")


def find_device(name: str) -> "torch.device":
    """The device of a name; of several GPUs, the one of this process's number on its machine (``LOCAL_RANK``).

    Args:
        name: One of `DEVICES`; ``auto`` is CUDA, else Apple's GPU, else the processor.

    Raises:
        ConfigError: If there is no such device.
    """
    import torch

    check_device(name)
    there = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available(), "cpu": True}
    if name == "auto":
        name = next(device for device, is_there in there.items() if is_there)
    if not there[name]:
        raise ConfigError(f"--device {name}: this torch ({torch.__version__}) finds no such device; use --device cpu")
    if name != "cuda":
        return torch.device(name)
    local = int(os.environ.get("LOCAL_RANK", "0"))
    return torch.device("cuda", local % torch.cuda.device_count())


def onnx_providers(device: str) -> list[str]:
    """Execution providers for onnxruntime in order of preference: CUDA if requested and available, else the CPU.

    Args:
        device: One of `DEVICES`; ``auto`` is CUDA if onnxruntime has it.

    Raises:
        ConfigError: If the device is requested by name and this onnxruntime lacks it.
    """
    check_device(device)
    if device in ("auto", "cuda") and onnxruntime_has_cuda():
        return ["CUDAExecutionProvider", "CPUExecutionProvider"]
    if device in ("auto", "cpu"):
        return ["CPUExecutionProvider"]
    if device == "mps":
        raise ConfigError("--device mps: ONNX files run on cpu or cuda")
    import onnxruntime

    raise ConfigError(
        f"--device cuda: this onnxruntime ({onnxruntime.__version__}) has no CUDA; install onnxruntime-gpu in its "
        "place, or use --device cpu"
    )


def onnxruntime_has_cuda() -> bool:
    """Whether onnxruntime is there and was built for CUDA."""
    if importlib.util.find_spec("onnxruntime") is None:
        return False
    import onnxruntime

    return "CUDAExecutionProvider" in onnxruntime.get_available_providers()
