"""Stage 1, depth: FastDepth, in metres for the given camera."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.errors import EdgeSlamError, WeightsError
from edgeslam_torch.frontend.network_input import check_image, network_size, preprocess
from edgeslam_torch.frontend.onnx_session import (
    EXIT_REFUSED,
    bound_memory,
    device_of,
    first_line,
    has_onnxruntime,
    open_session,
    try_apart,
    words_of,
)
from edgeslam_torch.geometry.camera import Camera
from edgeslam_torch.models.device import check_device, find_device, onnxruntime_has_cuda
from edgeslam_torch.models.layout import MAX_LOG_DEPTH
from edgeslam_torch.models.record import DEFAULT_WEIGHTS, SHIPPED_WEIGHTS, Metadata
from edgeslam_torch.types import DepthMap, FloatArray

if TYPE_CHECKING:
    import torch

    from edgeslam_torch.frontend.external_depth import ExternalDepth
    from edgeslam_torch.models.onnx.file import OnnxFile

logger = logging.getLogger(__name__)

_TRIAL_SIZE = 64
"""Side of the test images for newly loaded weights [px]; takes a few milliseconds."""
_LOG_RANGE = MAX_LOG_DEPTH - 1e-3
"""The network clips log depth to this range: values at its limits are out of range."""


class DepthNetwork(Protocol):
    """Depth of an undistorted image: the interface of every depth network."""

    weights: Path

    @property
    def is_metric(self) -> bool:
        """Whether its depth is in metres; otherwise its inverse is defined up to scale and shift."""

    @property
    def backend(self) -> str:
        """Name of its runtime."""

    def __call__(self, image: NDArray[np.uint8], camera: Camera) -> DepthMap:
        """Depth and its uncertainty at the size of the image, ``(H, W, 3)`` BGR or ``(H, W)`` grey."""


def open_depth(
    weights: Path | None = None, backend: str = "onnxruntime", threads: int = 1, device: str = "cpu"
) -> DepthNetwork:
    """A depth network from a file: FastDepth, or a third-party ONNX network with a description.

    Args:
        weights: A ``.safetensors`` file or an ``.onnx`` file; the shipped weights by default.
        backend: ``"onnxruntime"`` or ``"torch"``; an ONNX file runs in onnxruntime.
        threads: Threads per inference.
        device: ``cpu``, ``cuda``, ``mps``, or ``auto``: the fastest available.

    Raises:
        ConfigError: If there is no such device.
        WeightsError: If the weights are missing, damaged, not described, or give no depth.
        ValueError: If the backend is unknown.
    """
    if weights is None or weights.suffix != ".onnx":
        return DepthPredictor(weights, backend, threads, device)
    try_apart(weights)
    return _open_onnx(weights, backend, threads, device)


def trial(path: str) -> int:
    """Entry point of the subprocess of `try_apart`; exit code 0 if the network is usable."""
    bound_memory(Path(path))
    try:
        _open_onnx(Path(path)).try_larger()
    except EdgeSlamError as error:
        print(error)
        return EXIT_REFUSED
    return 0


def _open_onnx(
    weights: Path, backend: str = "onnxruntime", threads: int = 1, device: str = "cpu"
) -> "DepthPredictor | ExternalDepth":
    from edgeslam_torch.models.onnx.file import parse_onnx

    file = parse_onnx(weights)
    if file.is_ours:
        return DepthPredictor(file, backend, threads, device)
    from edgeslam_torch.frontend.external_depth import ExternalDepth

    return ExternalDepth(file, threads, device, DepthPredictor)


def weights_path(name: str) -> Path | None:
    """File of a depth network: ``default`` (None), ``near``, the name of a downloaded preset, or a path.

    Raises:
        WeightsError: If it is a preset that was not downloaded.
    """
    if name == "default":
        return None
    if name in SHIPPED_WEIGHTS:
        return SHIPPED_WEIGHTS[name]
    if Path(name).suffix or Path(name).exists():
        return Path(name)
    from edgeslam_torch.models.onnx.presets import PRESETS, preset_file

    if name not in PRESETS:
        close = ", ".join((*SHIPPED_WEIGHTS, *PRESETS))
        raise WeightsError(f"{name}: no such weights file, and no network of that name; there are {close}")
    path = preset_file(name)
    if not path.is_file():
        raise WeightsError(f"{name} is not there yet; fetch it with `edgeslam weights download {name}`")
    return path


class _Engine(Protocol):
    metadata: Metadata
    fixed_size: tuple[int, int] | None
    device: str
    """Device, as shown to the user."""

    def run(self, image: FloatArray) -> tuple[FloatArray, FloatArray]:
        """``(1, 3, H, W)`` -> log depth and sigma, both ``(H/2, W/2)``."""
        ...


class DepthPredictor:
    """Depth of an undistorted image.

    Args:
        weights: A ``.safetensors`` file or an exported ``.onnx`` file; the shipped weights by default.
        backend: ``"onnxruntime"`` (falls back to torch when it is not installed) or ``"torch"``.
        threads: Threads per inference. With torch this sets the number of threads of the process.
        device: ``cpu``, ``cuda``, ``mps``, or ``auto``: the fastest available. On a GPU weights run in onnxruntime
            if it supports CUDA, else in torch.

    Raises:
        ConfigError: If there is no such device.
        WeightsError: If the weights are missing, damaged, or give no depth.
        ValueError: If the backend is unknown.

    Example:
        >>> predictor = DepthPredictor()  # doctest: +SKIP
        >>> predictor(image, camera).depth_m.shape  # doctest: +SKIP
        (480, 640)
    """

    def __init__(
        self,
        weights: "Path | OnnxFile | None" = None,
        backend: str = "onnxruntime",
        threads: int = 1,
        device: str = "cpu",
    ) -> None:
        if backend not in ("onnxruntime", "torch"):
            raise ValueError(f"backend must be 'onnxruntime' or 'torch', got {backend!r}")
        weights = DEFAULT_WEIGHTS if weights is None else weights
        self.weights = weights if isinstance(weights, Path) else weights.path
        self._engine = _open_engine(weights, self.weights, backend, threads, device)
        _try_out(self._engine, self.weights)

    def try_larger(self) -> None:
        """Run it on an image of the training size, to detect memory that grows faster than the image."""
        height, width = self._engine.fixed_size or _training_size(self.metadata)
        self._engine.run(np.zeros((1, 3, height, width), np.float32))

    is_metric = True

    @property
    def metadata(self) -> Metadata:
        """Metadata of the weights."""
        return self._engine.metadata

    @property
    def backend(self) -> str:
        """Backend in use, and its device unless that is the CPU."""
        runtime = "torch" if isinstance(self._engine, _TorchEngine) else "onnxruntime"
        return words_of(runtime, self._engine.device)

    def __call__(self, image: NDArray[np.uint8], camera: Camera) -> DepthMap:
        """Depth [m] and its uncertainty at the image's size; NaN outside the network's range (1 cm to 100 m).

        The network predicts metres for its training focal length. The same image at twice the focal length shows a
        scene at twice the distance, so depth is multiplied by the ratio of focal lengths in network pixels.

        Args:
            image: ``(H, W, 3)`` BGR or ``(H, W)`` grey, undistorted.
            camera: Intrinsics of that image.

        Raises:
            ValueError: If the image's size is not the camera's or it has neither one nor three channels.
        """
        check_image(image, camera)
        height, width = self._engine.fixed_size or network_size(
            camera.height, camera.width, _training_size(self.metadata)
        )
        log_depth, sigma = self._engine.run(preprocess(image, height, width, self.metadata))
        log_depth = np.where(np.abs(log_depth) < _LOG_RANGE, log_depth, np.float32(np.nan))
        small = camera.scaled(width, height)
        focal_ratio = float(np.sqrt(small.fx * small.fy)) / self.metadata.focal_px
        size = (camera.width, camera.height)
        depth_m = cv2.resize(np.exp(log_depth) * np.float32(focal_ratio), size, interpolation=cv2.INTER_LINEAR)
        sigma_log = cv2.resize(sigma, size, interpolation=cv2.INTER_LINEAR)
        return DepthMap(np.asarray(depth_m, np.float32), np.asarray(sigma_log, np.float32))


def _training_size(metadata: Metadata) -> tuple[int, int]:
    return metadata.input_height, metadata.input_width


def _open_engine(weights: "Path | OnnxFile", path: Path, backend: str, threads: int, device: str) -> _Engine:
    check_device(device)
    if path.suffix == ".onnx":
        if backend == "torch":
            raise WeightsError(f"{path}: an ONNX file runs in onnxruntime only, not with backend 'torch'")
        return _OnnxEngine(weights, path, threads, device)
    if backend == "torch" or not (device == "cpu" or onnxruntime_has_cuda()):
        where = find_device(device)
        if backend == "torch" or where.type != "cpu":
            return _TorchEngine(path, threads, where)
    if has_onnxruntime():
        return _OnnxEngine(weights, path, threads, device)
    logger.warning("onnxruntime is not installed: depth runs in torch, about twice as slow")
    return _TorchEngine(path, threads, find_device("cpu"))


def _try_out(engine: _Engine, weights: Path) -> None:
    """Reject weights that predict no depth for two simple images, or the same for both.

    Raises:
        WeightsError: If they are rejected or cannot be run.
    """
    height, width = engine.fixed_size or (_TRIAL_SIZE, _TRIAL_SIZE)
    across, down = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    picture = np.stack([across, down, 255 - across], axis=2).astype(np.uint8)
    answers = []
    for image in (picture, np.ascontiguousarray(picture[::-1])):
        try:
            log_depth, sigma = engine.run(preprocess(image, height, width, engine.metadata))
        except Exception as error:  # onnxruntime's errors have no common base class
            raise WeightsError(f"{weights}: cannot be run ({first_line(error)})") from error
        if log_depth.shape != (height // 2, width // 2) or sigma.shape != log_depth.shape:
            raise WeightsError(f"{weights}: gives depth of shape {log_depth.shape} for a picture of {height}x{width}")
        known = np.isfinite(log_depth) & (np.abs(log_depth) < _LOG_RANGE) & np.isfinite(sigma) & (sigma > 0)
        if not known.any():
            raise WeightsError(f"{weights}: gives no depth: every pixel is not finite or at the end of its range")
        answers.append(log_depth)
    if np.array_equal(answers[0], answers[1], equal_nan=True):
        raise WeightsError(f"{weights}: gives the same depth for different images")


class _OnnxEngine:
    def __init__(self, weights: "Path | OnnxFile", path: Path, threads: int, device: str) -> None:
        if path.suffix == ".onnx":
            from edgeslam_torch.models.onnx.file import read_onnx

            model: Path | bytes
            model, self.metadata = read_onnx(weights)
        else:
            from edgeslam_torch.models.onnx.cache import cached_graph

            model, self.metadata = cached_graph(path)
        try:
            self._session = open_session(model, path, threads, device)
        except WeightsError:
            if not isinstance(model, Path):
                raise
            model.unlink(missing_ok=True)  # a damaged file in the cache
            self._session = open_session(cached_graph(path)[0], path, threads, device)
        self.device = device_of(self._session)
        height, width = self._session.get_inputs()[0].shape[2:]
        self.fixed_size = (height, width) if isinstance(height, int) and isinstance(width, int) else None

    def run(self, image: FloatArray) -> tuple[FloatArray, FloatArray]:
        log_depth, sigma = self._session.run(["log_depth", "sigma_log"], {"image": image})
        return log_depth[0, 0], sigma[0, 0]


class _TorchEngine:
    fixed_size: tuple[int, int] | None = None

    def __init__(self, weights: Path, threads: int, device: "torch.device") -> None:
        import torch

        from edgeslam_torch.models.checkpoint import load_checkpoint
        from edgeslam_torch.models.onnx.fold import deployed

        torch.set_num_threads(threads)
        network, self.metadata = load_checkpoint(weights)
        module = deployed(network, self.metadata).to(device)
        self._network = module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._device, self.device = device, str(device)

    def run(self, image: FloatArray) -> tuple[FloatArray, FloatArray]:
        import torch

        with torch.inference_mode():
            x = torch.from_numpy(image).to(self._device).to(memory_format=torch.channels_last)
            log_depth, sigma = self._network(x)
        return log_depth[0, 0].cpu().numpy(), sigma[0, 0].cpu().numpy()
