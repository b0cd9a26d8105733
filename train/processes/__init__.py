"""Long work in one process or several: progress, and `torchrun`."""
