"""Errors of evaluation, naming the likely mistake."""

from edgeslam_torch.errors import EdgeSlamError


class EvaluationError(EdgeSlamError):
    """Two files cannot be compared; the message gives the probable cause."""
