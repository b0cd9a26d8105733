"""Parameters and multiply-accumulate operations of a network."""

from dataclasses import dataclass

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode


@dataclass(frozen=True, slots=True)
class Complexity:
    """Size of a network."""

    parameters: int
    macs: int
    """Multiply-accumulates of all convolutions for one image."""


def measure_complexity(network: nn.Module, height: int, width: int) -> Complexity:
    """Count parameters and multiply-accumulates of one forward pass over ``(1, 3, height, width)``; biases and batch
    norm are not counted."""
    was_training = network.training
    parameter = next(network.parameters())
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        network.eval()(torch.zeros(1, 3, height, width, device=parameter.device, dtype=parameter.dtype))
    network.train(was_training)
    return Complexity(sum(p.numel() for p in network.parameters()), counter.get_total_flops() // 2)
