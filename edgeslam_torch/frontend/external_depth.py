"""Stage 1, depth: third-party networks as ONNX files, metric for the given camera or relative."""

import logging
import time
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.frontend.depth_check import CONTRADICTION, DepthFunction, order_agreement
from edgeslam_torch.frontend.network_input import check_image, network_size, preprocess
from edgeslam_torch.frontend.onnx_session import device_of, first_line, open_session, words_of
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.models.onnx.external import Gives, channels_last, read_external
from edgeslam_torch.types import DepthMap, FloatArray

if TYPE_CHECKING:
    from edgeslam_torch.models.onnx.file import OnnxFile

logger = logging.getLogger(__name__)

FARTHEST = 2.0
"""Assumed largest depth of a relative network, relative to the median depth, until the map determines it. The 98th
percentile of measured indoor depth is 1.4 to 2.7."""
FARTHEST_PERCENTILE = 2.0
BEYOND = 4.0
"""Factor on `FARTHEST` above which relative depth is unknown."""
NUMBERS = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
}
"""Input types of a network by onnxruntime's names."""
SLOW_S = 1.0
"""Time per image above which a smaller input is suggested."""
SAME_UNIT = 1.5
"""Maximum median log ratio of depths (a factor of 4.5) of two networks with the same unit."""
OTHER_READING = 0.7
"""Median log ratio (a factor of two) above which another reading is tried: metres read as their logarithm, or the
reverse, are off by a factor of e or more."""
_TRIAL_SIDE = 112
"""Side of the test images [px], rounded up: eight patches of a vision transformer."""


class ExternalDepth:
    """Depth of an undistorted image by an ONNX network with a description (`models.onnx.external`).

    Args:
        weights: The ``.onnx`` file.
        threads: Threads per inference.
        device: ``cpu``, ``cuda``, or ``auto``: CUDA if onnxruntime supports it.
        open_reference: Opens another network, to detect exchanged near and far (`CheckedDepth`).

    Raises:
        ConfigError: If there is no such device.
        WeightsError: If it is missing, damaged, not described, cannot be run, or gives no depth.

    Example:
        >>> ExternalDepth(Path("midas-small.onnx"))(image, camera).is_relative  # doctest: +SKIP
        True
    """

    def __init__(
        self,
        weights: "Path | OnnxFile",
        threads: int = 1,
        device: str = "cpu",
        open_reference: Callable[[], DepthFunction] | None = None,
    ) -> None:
        self.weights = weights if isinstance(weights, Path) else weights.path
        content, self.network = read_external(weights)
        self._session = open_session(content, self.weights, threads, device)
        self.backend = words_of("onnxruntime", device_of(self._session))
        ends = {end.name: end for end in self._session.get_inputs()}
        if list(ends) != [self.network.input]:
            raise WeightsError(f"{self.weights}: it must take one image; its inputs are {', '.join(ends)}")
        taken = ends[self.network.input]
        sides = [side if isinstance(side, int) else 0 for side in taken.shape]
        self._channels_last = channels_last(sides)
        self._fixed = sides[1:3] if self._channels_last else sides[2:]
        if taken.type not in NUMBERS:
            raise WeightsError(f"{self.weights}: it takes {taken.type}, not one of {', '.join(NUMBERS)}")
        self._numbers = NUMBERS[taken.type]
        if self._numbers is np.uint8 and not (set(self.network.mean) == {0.0} and set(self.network.std) == {1.0}):
            raise WeightsError(f"{self.weights}: it takes whole numbers from 0 to 255: leave out mean and std")
        self._said_slow = False
        self._try_out()
        self._open_reference = open_reference

    @property
    def is_metric(self) -> bool:
        """Whether its depth is in metres."""
        return not self.network.is_relative

    def __call__(self, image: NDArray[np.uint8], camera: Camera) -> DepthMap:
        """Depth and its uncertainty at the image's size; NaN where the network predicts none.

        Metric depth is multiplied by the ratio of focal lengths if the network was trained for one. Relative depth is
        normalised to a median of 1 and a maximum of `FARTHEST`: its inverse is defined up to scale and shift.

        Args:
            image: ``(H, W, 3)`` BGR or ``(H, W)`` grey, undistorted.
            camera: Intrinsics of that image.

        Raises:
            ValueError: If the image's size is not the camera's or it has neither one nor three channels.
        """
        network = self.network
        given, sigma_log = self._given(image, camera)
        if network.is_relative:
            return DepthMap(relative_depth(given), sigma_log, is_relative=True)
        return DepthMap(self._in_metres(given, camera, network.gives), sigma_log)

    def _in_metres(self, given: FloatArray, camera: Camera, gives: str) -> FloatArray:
        """Depth [m] for the camera."""
        height, width = self._input_size(camera)
        lens, focal_px = camera.scaled(width, height), self.network.focal_px
        longer = float(np.sqrt(lens.fx * lens.fy)) / focal_px if focal_px else 1.0
        return np.asarray(longer * _metres(given, gives), np.float32)

    def _input_size(self, camera: Camera) -> tuple[int, int]:
        training = (self.network.input_height, self.network.input_width)
        return self._taken(*network_size(camera.height, camera.width, training, self.network.multiple))

    def _given(self, image: NDArray[np.uint8], camera: Camera) -> tuple[FloatArray, FloatArray]:
        """The network's raw output and its sigma, at the image's size ``(H, W)``."""
        check_image(image, camera)
        height, width = self._input_size(camera)
        start_s = time.perf_counter()
        small, sigma = self._run(preprocess(image, height, width, self.network))
        took_s = time.perf_counter() - start_s
        if took_s > SLOW_S and not all(self._fixed) and not self._said_slow:
            self._said_slow = True
            logger.warning(
                f"{self.weights.name} took {took_s:.1f} s for one image of {width}x{height}: smaller input_height and "
                f"input_width in its description cost less"
            )
        to_image = (camera.width, camera.height)
        given = np.asarray(cv2.resize(small, to_image, interpolation=cv2.INTER_LINEAR), np.float32)
        if sigma is None:
            return given, np.full(given.shape, self.network.sigma_log, np.float32)
        return given, np.asarray(cv2.resize(sigma, to_image, interpolation=cv2.INTER_LINEAR), np.float32)

    @cached_property
    def reference(self) -> DepthFunction | None:
        """The reference depth network; None without one."""
        return None if self._open_reference is None else self._open_reference()

    def contradiction(self, depth: DepthMap, image: NDArray[np.uint8], camera: Camera, reference: DepthMap) -> str:
        """How the description contradicts a reference depth map of the same image, and the value of ``gives`` that fits
        better; empty if it does not.

        Near and far are exchanged, or the output read as `Gives` says deviates from the reference by more than a factor
        of two, and by less than half of that when read otherwise.
        """
        said = self.network.gives
        inside_out = order_agreement(depth, reference) < CONTRADICTION
        other_unit = not depth.is_relative and _deviation(depth.depth_m, reference) > OTHER_READING
        if not (inside_out or other_unit):
            return ""
        given = self._given(image, camera)[0]
        deviation = {
            gives: _deviation(self._in_metres(given, camera, gives), reference)
            for gives in (Gives.METRES, Gives.LOG_METRES, Gives.INVERSE_METRES)
        }
        fits = Gives.LOG_METRES if deviation[Gives.LOG_METRES] < deviation[Gives.METRES] else Gives.METRES
        if inside_out:
            if said in (Gives.METRES, Gives.LOG_METRES):  # output falls where the reference rises
                fits = Gives.INVERSE_METRES if deviation[Gives.INVERSE_METRES] < SAME_UNIT else Gives.RELATIVE_INVERSE
        elif not deviation[fits] < 0.5 * deviation[Gives(said)]:
            return ""
        return f"{self.weights.name} is described as {said}, its numbers look like gives = '{fits}'"

    def _taken(self, height: int, width: int) -> tuple[int, int]:
        """The input size, with the sides that the graph fixes."""
        return self._fixed[0] or height, self._fixed[1] or width

    def _run(self, image: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """The network's output and its sigma, ``(h, w)`` each.

        Raises:
            WeightsError: If the network does not accept an image of this size, or its output is no single plane.
        """
        names = [name for name in (self.network.depth, self.network.sigma) if name]
        try:
            found = self._session.run(names, {self.network.input: self._as_taken(image)})
            planes = [_plane(np.asarray(array, np.float32)) for array in found]
        except Exception as error:  # onnxruntime's errors have no common base class
            size = f"{image.shape[2]}x{image.shape[3]}"
            raise WeightsError(f"{self.weights}: cannot be run on {size} pixels ({first_line(error)})") from error
        return planes[0], planes[1] if self.network.sigma else None

    def _as_taken(self, image: FloatArray) -> NDArray[np.generic]:
        """The input ``(1, 3, H, W)`` in the layout and the data type of the graph."""
        if self._channels_last:
            image = np.ascontiguousarray(image.transpose(0, 2, 3, 1))
        if self._numbers is np.uint8:
            image = np.clip(np.rint(255.0 * image), 0, 255)
        return image.astype(self._numbers, copy=False)

    def try_larger(self) -> None:
        """Run it on images of twice the side, to detect memory that grows with the square of the pixels."""
        height, width = self._trial_size(2 * _TRIAL_SIDE)
        self._run(np.zeros((1, 3, height, width), np.float32))

    def _trial_size(self, side: int) -> tuple[int, int]:
        side = -(-side // self.network.multiple) * self.network.multiple
        return self._taken(side, side)

    def _try_out(self) -> None:
        """Reject a network that gives no depth for two simple images, or the same for both."""
        height, width = self._trial_size(_TRIAL_SIDE)
        across, down = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
        picture = np.stack([across, down, 255 - across], axis=2).astype(np.uint8)
        answers = []
        for image in (picture, np.ascontiguousarray(picture[::-1])):
            given, _ = self._run(preprocess(image, height, width, self.network))
            depth = relative_depth(given) if self.network.is_relative else _metres(given, self.network.gives)
            if not np.isfinite(depth).any():
                raise WeightsError(f"{self.weights}: gives no depth, if its numbers are {self.network.gives}")
            answers.append(given)
        if np.array_equal(answers[0], answers[1], equal_nan=True):
            raise WeightsError(f"{self.weights}: gives the same depth for different images")


def _deviation(depth_m: FloatArray, reference: DepthMap) -> float:
    """Median absolute log ratio of two depth maps; NaN without common pixels."""
    known = np.isfinite(depth_m) & np.isfinite(reference.depth_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = np.abs(np.log(depth_m[known] / reference.depth_m[known]))
    return float(np.median(apart)) if apart.size else float("nan")


def _plane(array: FloatArray) -> FloatArray:
    """``(h, w)`` of ``(1, 1, h, w)``, ``(1, h, w, 1)``, ``(1, h, w)``."""
    while array.ndim > 2 and 1 in (array.shape[0], array.shape[-1]):
        array = array[0] if array.shape[0] == 1 else array[..., 0]
    if array.ndim != 2:
        raise ValueError(f"its depth has the shape {array.shape}, not one plane")
    return array


def _metres(given: FloatArray, gives: str) -> FloatArray:
    """Depth [m] for the training camera; NaN where it is not positive."""
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        depth = {
            Gives.METRES: lambda: given,
            Gives.LOG_METRES: lambda: np.exp(given),
            Gives.INVERSE_METRES: lambda: 1.0 / given,
        }[Gives(gives)]()
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))


def relative_depth(inverse: FloatArray) -> FloatArray:
    """Depth whose inverse is an affine function of the given one, with a median of 1 and a maximum of `FARTHEST`.

    Args:
        inverse: ``(H, W)`` inverse depth up to scale and shift.

    Returns:
        ``(H, W)`` float32; NaN where unknown, everywhere if the input is constant.

    Example:
        >>> relative_depth(np.array([[1.0, 2.0, 3.0]], np.float32)).round(1)
        array([[2.1, 1. , 0.7]], dtype=float32)
    """
    known = np.isfinite(inverse)
    if not known.any():
        return np.full(inverse.shape, np.nan, np.float32)
    far, middle = np.percentile(inverse[known], [FARTHEST_PERCENTILE, 50.0])
    if not middle > far:
        return np.full(inverse.shape, np.nan, np.float32)
    share = (inverse - far) / (middle - far)
    normalised = 1.0 / FARTHEST + (1.0 - 1.0 / FARTHEST) * share
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(normalised > 1.0 / (BEYOND * FARTHEST), 1.0 / normalised, np.nan).astype(np.float32)
