"""Where training runs, and in which arithmetic."""

from dataclasses import dataclass

import torch
from torch import Tensor

from edgeslam_torch.models.device import find_device


@dataclass(frozen=True, slots=True)
class Arithmetic:
    """Device of a training and the type that autocast computes in."""

    device: torch.device
    dtype: torch.dtype | None
    """None: float32 everywhere."""

    def autocast(self) -> torch.autocast:
        """Context of the forward pass and the losses."""
        return torch.autocast(self.device.type, self.dtype or torch.bfloat16, enabled=self.dtype is not None)

    def moved(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """A batch on the device."""
        return {name: value.to(self.device, non_blocking=True) for name, value in batch.items()}


def arithmetic(device: str, amp: bool | None) -> Arithmetic:
    """Device, as `find_device` names it, and type of a training; half precision if asked for, or on CUDA.

    Raises:
        ConfigError: If there is no such device.
    """
    found = find_device(device)
    if not (found.type == "cuda" if amp is None else amp):
        return Arithmetic(found, None)
    is_old = found.type == "cuda" and not torch.cuda.is_bf16_supported(including_emulation=False)
    return Arithmetic(found, torch.float16 if is_old else torch.bfloat16)
