"""Parameters and multiply-accumulate operations of a network."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn


@dataclass(frozen=True, slots=True)
class Complexity:
    """Size of a network."""

    parameters: int
    macs: int
    """Multiply-accumulates of all convolutions for one image."""


def measure_complexity(network: nn.Module, height: int, width: int) -> Complexity:
    """Count parameters and multiply-accumulates of one forward pass over ``(1, 3, height, width)``; biases and batch
    norm are not counted."""
    macs = 0

    def count(module: nn.Module, _: tuple[Tensor, ...], output: Tensor) -> None:
        nonlocal macs
        assert isinstance(module, nn.Conv2d)
        taps = module.weight[0].numel()
        macs += taps * output[0].numel()

    hooks = [m.register_forward_hook(count) for m in network.modules() if isinstance(m, nn.Conv2d)]
    was_training = network.training
    parameter = next(network.parameters())
    try:
        with torch.no_grad():
            network.eval()(torch.zeros(1, 3, height, width, device=parameter.device, dtype=parameter.dtype))
    finally:
        network.train(was_training)
        for hook in hooks:
            hook.remove()
    return Complexity(sum(p.numel() for p in network.parameters()), macs)
