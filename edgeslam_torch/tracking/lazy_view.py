"""A frame whose features are extracted on first use; most frames between keyframes never need them."""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.tracking.tracker import View


class LazyView:
    """One frame for tracking.

    Args:
        grey: ``(H, W)`` uint8 with the lens distortion still in it.
        extract: Makes the features of a grey image.
    """

    def __init__(self, grey: NDArray[np.uint8], extract: Callable[[NDArray[np.uint8]], View]) -> None:
        self.grey = grey
        self._extract = extract

    @cached_property
    def view(self) -> View:
        """The features, extracted once."""
        return self._extract(self.grey)
