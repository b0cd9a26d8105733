"""Hooks that report training: progress with time left, and TensorBoard."""

import importlib.util
import logging
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from edgeslam_torch.extras import install_command
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.terminal.progress import Progress
from edgeslam_torch.train.hooks import Hooks
from edgeslam_torch.train.processes.distributed import rank
from edgeslam_torch.train.state import TrainConfig, TrainState
from edgeslam_torch.train.validate import predict_metres
from edgeslam_torch.train.views.augment import View

logger = logging.getLogger(__name__)

PICTURE_SIZE = (320, 240)


class ProgressBar(Hooks):
    """Step, loss, learning rate, time left."""

    def __init__(self) -> None:
        self._progress: Progress | None = None

    def on_start(self, state: TrainState, config: TrainConfig) -> None:
        """Begin where the run stands."""
        self._progress = Progress("training", config.steps, "step", done=state.step, shown=rank() == 0)

    def on_step(self, state: TrainState, losses: dict[str, float]) -> None:
        """Advance."""
        assert self._progress is not None
        rate = state.optimiser.param_groups[-1]["lr"]
        words = f"loss {sum(losses.values()):.4f}, lr {rate:.1e}"
        self._progress.words = lambda: words
        self._progress.advance()

    def close(self) -> None:
        """Leave the terminal's line."""
        if self._progress is not None:
            self._progress.close()


def curves(folder: Path, metadata: Metadata, views: Sequence[View]) -> list[Hooks]:
    """`TensorBoard` where it is installed; training goes on without it."""
    if importlib.util.find_spec("tensorboard") is None:
        logger.warning("no curves are written: TensorBoard is not installed: %s", install_command("train"))
        return []
    return [TensorBoard(folder, metadata, views)]


class TensorBoard(Hooks):
    """Losses by name at every step, metrics and pictures (input, depth, error, edges) at every validation."""

    def __init__(self, folder: Path, metadata: Metadata, views: Sequence[View]) -> None:
        self._folder, self._metadata, self._views = folder, metadata, views

    def on_start(self, state: TrainState, config: TrainConfig) -> None:
        """Open the file; later steps of an interrupted process are purged."""
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(self._folder), purge_step=state.step + 1)

    def on_step(self, state: TrainState, losses: dict[str, float]) -> None:
        """Scalars under ``loss/``."""
        for name, value in losses.items():
            self._writer.add_scalar(f"loss/{name}", value, state.step)
        self._writer.add_scalar("loss/sum", sum(losses.values()), state.step)
        self._writer.add_scalar("lr", state.optimiser.param_groups[-1]["lr"], state.step)

    def on_validation(self, state: TrainState, metrics: dict[str, float]) -> None:
        """Scalars under ``validation/`` and one strip of pictures per view."""
        for name, value in metrics.items():
            self._writer.add_scalar(f"validation/{name}", value, state.step)
        for k, view in enumerate(self._views):
            depth, _ = predict_metres(state.averaged, self._metadata, view)
            self._writer.add_image(f"view {k}", picture(view, depth)[..., ::-1], state.step, dataformats="HWC")

    def on_end(self, state: TrainState, reason: str) -> None:
        """Note why."""
        self._writer.add_text("end", reason, state.step)

    def close(self) -> None:
        """Close the file; a full disk was reported by the step that met it."""
        with suppress(OSError, AttributeError):
            self._writer.close()


def picture(view: View, depth_m: np.ndarray) -> np.ndarray:
    """Input, predicted depth, relative error (0 to 50 %) and Canny edges side by side, BGR uint8."""
    image = cv2.resize(view.image, PICTURE_SIZE, interpolation=cv2.INTER_AREA)
    known = view.depth_m > 0
    error = np.where(known, np.abs(depth_m / np.maximum(view.depth_m, 1e-3) - 1), 0.0)
    panels = [_coloured(0.5 / np.maximum(depth_m, 0.5)), _coloured(error / 0.5)]
    edges = np.repeat(cv2.Canny(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), 50, 150)[..., None], 3, axis=2)
    return np.hstack([image, *panels, edges])


def _coloured(level: np.ndarray) -> np.ndarray:
    grey = cv2.resize((np.clip(level, 0, 1) * 255).astype(np.uint8), PICTURE_SIZE, interpolation=cv2.INTER_NEAREST)
    return np.asarray(cv2.applyColorMap(grey, cv2.COLORMAP_TURBO))
