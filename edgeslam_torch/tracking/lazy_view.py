"""A frame whose features are extracted on first use; most frames between keyframes never need them."""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import SourceError
from edgeslam_torch.frontend.image import as_grey
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.tracking.tracker import View
from edgeslam_torch.types import Frame


class LazyView:
    """One frame for tracking.

    Args:
        frame: Image with the lens distortion still in it.
        camera: Its intrinsics.
        extract: Extracts the features of a grey image.

    Raises:
        SourceError: If the image is not of the camera's size.
    """

    def __init__(self, frame: Frame, camera: Camera, extract: Callable[[NDArray[np.uint8]], View]) -> None:
        self.grey = as_grey(frame.image) if frame.grey is None else frame.grey
        """``(H, W)``"""
        height, width = self.grey.shape
        if (width, height) != (camera.width, camera.height):
            raise SourceError(
                f"{frame.name}: image is {width}x{height}, the calibration {camera.width}x{camera.height}"
            )
        self._extract = extract

    @cached_property
    def view(self) -> View:
        """The features, extracted once."""
        return self._extract(self.grey)
