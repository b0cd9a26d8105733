"""Batch norm over the images of all processes; torch's own (`torch.nn.SyncBatchNorm`) runs on GPUs alone."""

from torch import Tensor, nn

from edgeslam_torch.train.processes.distributed import lost_is_said


class SharedBatchNorm2d(nn.BatchNorm2d):
    """`torch.nn.BatchNorm2d` whose batch is that of all processes, which may have different numbers of images."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalised ``(B, C, H, W)``; in training by mean and variance over ``B``, ``H``, ``W`` of all processes."""
        if not self.training:
            return super().forward(x)
        of_channel = (1, -1, 1, 1)
        wide = x.float()
        count = _everywhere(wide.new_tensor(float(x.numel() // x.shape[1])))
        mean = _everywhere(wide.sum((0, 2, 3))) / count
        centred = wide - mean.view(of_channel)
        variance = _everywhere(centred.square().sum((0, 2, 3))) / count
        self._remember(mean.detach(), variance.detach() * count / (count - 1.0).clamp(min=1.0))
        scaled = centred * (variance + self.eps).rsqrt().view(of_channel)
        return (scaled * self.weight.view(of_channel) + self.bias.view(of_channel)).to(x.dtype)

    def _remember(self, mean: Tensor, variance: Tensor) -> None:
        assert self.running_mean is not None and self.running_var is not None and self.num_batches_tracked is not None
        assert self.momentum is not None
        self.num_batches_tracked.add_(1)
        self.running_mean.lerp_(mean, self.momentum)
        self.running_var.lerp_(variance, self.momentum)


def share_norms(network: nn.Module) -> None:
    """Replace every `torch.nn.BatchNorm2d` in ``network``; parameters, statistics and their names stay."""
    for name, child in network.named_children():
        if type(child) is not nn.BatchNorm2d:
            share_norms(child)
            continue
        shared = SharedBatchNorm2d(child.num_features, child.eps, child.momentum)
        shared.weight, shared.bias = child.weight, child.bias
        shared.running_mean, shared.running_var = child.running_mean, child.running_var
        shared.num_batches_tracked = child.num_batches_tracked
        shared.train(child.training)
        setattr(network, name, shared)


def _everywhere(x: Tensor) -> Tensor:
    """Sum over the processes; each process's loss depends on it, so its gradient is the sum of theirs."""
    from torch.distributed.nn.functional import all_reduce  # not in every build of torch

    with lost_is_said():
        return all_reduce(x)
