"""The recipe of the shipped weights: ``python -m edgeslam_torch.train.recipes.default_weights --data DIR --out DIR``.

1. Encoder from ImageNet; recordings and rendered rooms mixed, at a constant rate.
2. Fewer rendered rooms and gentler augmentation, the rate falling to nothing.
3. Calibration of the uncertainty on views of rooms held out from both.

The evaluation sequences are not used, except to plot the curve (``--watch``); the last weights are kept, not the best
on the curve.
"""

import argparse
import dataclasses
import logging
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from edgeslam_torch.models.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgeslam_torch.models.imagenet import load_imagenet_encoder
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.calibrate_sigma import calibrate_sigma
from edgeslam_torch.train.hooks import Hooks
from edgeslam_torch.train.recipe import train
from edgeslam_torch.train.signals import Source, Supervised
from edgeslam_torch.train.state import TrainConfig, TrainState
from edgeslam_torch.train.validate import score
from edgeslam_torch.train.views.augment import AugmentConfig, View
from edgeslam_torch.train.views.datasets import load_depth_folder
from edgeslam_torch.train.views.rendered import load_rendered, render_rooms

logger = logging.getLogger(__name__)

IMAGENET = "mobilenet_v1_imagenet/mobilenet_v1_1.0_224_quant_embedding_extractor.tflite"
INPUT_SIZE = (160, 224)
"""Height and width [px]; a third faster than 192x256 and as accurate (model card)."""
REAL = ("tum_fr1_rpy_depth", "icl_livingroom1")
RENDERED = "rendered"
BROAD = {"tum_fr1_rpy_depth": 0.5, "icl_livingroom1": 0.15, RENDERED: 0.35}
"""Shares of the batch in phase 1."""
SETTLE = {"tum_fr1_rpy_depth": 0.65, "icl_livingroom1": 0.15, RENDERED: 0.2}
"""Shares of the batch in phase 2, closer to real cameras."""
RENDERED_METRIC = 0.1
"""Rendered rooms supervise shape only: their sizes are invented, and with 1 the metric error on redkitchen doubled
within 250 steps."""
HELD_OUT_VIEWS = 150
"""Last rendered views, whole rooms, kept out of training for the calibration."""
LICENCE = (
    "Apache-2.0; encoder initialised from google-coral's MobileNetV1 (Apache-2.0); trained on TUM RGB-D freiburg1_rpy "
    "(CC BY 4.0, Sturm et al. 2012), ICL-NUIM living room 1 (CC BY 3.0, Handa et al. 2014) and rooms rendered by "
    "this project"
)


@dataclass(frozen=True, slots=True)
class Recipe:
    """Settings of the shipped weights."""

    rooms: int = 350
    views_per_room: int = 6
    with_rendered: bool = True
    """Whether rendered rooms are trained on; without, the recordings share their part."""
    broad: TrainConfig = TrainConfig(
        steps=2200, lr=1e-3, encoder_lr=1.2e-4, lr_end=1.0, validate_every=550, checkpoint_every=100
    )
    settle: TrainConfig = TrainConfig(
        steps=1000, lr=1e-3, encoder_lr=1.2e-4, seed=1, warmup_steps=20, validate_every=500, checkpoint_every=100
    )
    broad_augment: AugmentConfig = AugmentConfig(
        zoom=(0.9, 1.4), aspect=0.05, roll_rad=0.12, tilt_rad=0.08, shift=0.1, saturation=0.4, gamma=(0.8, 1.25)
    )
    settle_augment: AugmentConfig = AugmentConfig(
        zoom=(0.95, 1.25), aspect=0.04, roll_rad=0.1, tilt_rad=0.05, shift=0.1, saturation=0.4, gamma=(0.8, 1.25)
    )


class Progress(Hooks):
    """Logs losses and time left."""

    def __init__(self, every: int = 50) -> None:
        self.every = every
        self.start, self.first = time.monotonic(), 0
        self.steps = 0

    def on_start(self, state: TrainState, config: TrainConfig) -> None:
        """Note where this process begins."""
        self.start, self.first, self.steps = time.monotonic(), state.step, config.steps

    def on_step(self, state: TrainState, losses: dict[str, float]) -> None:
        """One line every ``every`` steps."""
        if state.step % self.every == 0:
            rate = (time.monotonic() - self.start) / (state.step - self.first)
            terms = " ".join(f"{k.split('/')[-1]} {v:.4f}" for k, v in losses.items())
            logger.info(
                "step %d/%d %s (%.0f min left)", state.step, self.steps, terms, rate * (self.steps - state.step) / 60
            )

    def on_validation(self, state: TrainState, metrics: dict[str, float]) -> None:
        """One line each."""
        logger.info("step %d: %s", state.step, " ".join(f"{k} {v:.4f}" for k, v in metrics.items()))


class Scores:
    """Of a network on named sets; the first one decides."""

    def __init__(self, metadata: Metadata, sets: dict[str, Sequence[View]]) -> None:
        self.metadata, self.sets, self.start = metadata, sets, time.monotonic()

    def __call__(self, network: DepthModule) -> dict[str, float]:
        """As `train` takes it."""
        metrics: dict[str, float] = {}
        for name, views in self.sets.items():
            for key, value in dataclasses.asdict(score(network, self.metadata, views)).items():
                metrics[f"{name}/{key}"] = round(value, 4)
        metrics["score"] = metrics[f"{next(iter(self.sets))}/abs_rel_scaled"]
        metrics["wall_s"] = round(time.monotonic() - self.start)
        metrics["cpu_s"] = round(time.process_time())
        return metrics


def make_default_weights(data: Path, out: Path, recipe: Recipe, watch: Sequence[str] = ()) -> Path:
    """Run all phases; each resumes where it was killed.

    Args:
        data: Folder with the recordings and the ImageNet encoder.
        out: Folder for everything.
        recipe: Numbers.
        watch: Recordings under ``data`` drawn into the curve, never trained on.

    Returns:
        The finished weights file.
    """
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(0)
    height, width = INPUT_SIZE
    broad, settle = (
        {name: share for name, share in shares.items() if recipe.with_rendered or name != RENDERED}
        for shares in (BROAD, SETTLE)
    )
    data_names = ("ImageNet (encoder)", *broad)
    metadata = Metadata(input_height=height, input_width=width, data=data_names, licence=LICENCE)
    rooms = out / "rendered.npz"
    if not rooms.is_file():
        render_rooms(rooms, recipe.rooms, recipe.views_per_room)
    rendered = load_rendered(rooms)
    held_out, rendered = rendered[-HELD_OUT_VIEWS:], rendered[:-HELD_OUT_VIEWS]
    pools: dict[str, Sequence[View]] = {name: load_depth_folder(data / name).views for name in REAL}
    pools[RENDERED] = rendered
    watched = {name: load_depth_folder(data / name, 640, stride=6).views for name in watch}
    validate = Scores(metadata, {RENDERED: held_out, **watched})
    network = build_network(metadata)
    load_imagenet_encoder(network, data / IMAGENET)
    _phase(network, metadata, pools, broad, recipe.broad, recipe.broad_augment, out / "broad", validate)
    network = load_checkpoint(out / "broad" / "final.safetensors")[0]
    _phase(network, metadata, pools, settle, recipe.settle, recipe.settle_augment, out / "settle", validate)
    network = load_checkpoint(out / "settle" / "final.safetensors")[0]
    metadata = calibrate_sigma(network, metadata, held_out)
    save_checkpoint(network, metadata, out / "default.safetensors", half=True)
    return out / "default.safetensors"


def _phase(
    network: DepthModule,
    metadata: Metadata,
    pools: dict[str, Sequence[View]],
    shares: dict[str, float],
    config: TrainConfig,
    augment: AugmentConfig,
    out: Path,
    validate: Scores,
) -> None:
    if (out / "final.safetensors").is_file():
        logger.info("%s is there already", out / "final.safetensors")
        return
    metric = {RENDERED: RENDERED_METRIC}
    sources = [Source(name, pools[name], share, metric.get(name, 1.0)) for name, share in shares.items()]
    train(network, metadata, [Supervised(sources, metadata, augment)], config, out, validate, [Progress()])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--watch", nargs="*", default=[], help="recordings drawn into the curve, never trained on")
    parser.add_argument("--steps", type=int, nargs=2, metavar=("BROAD", "SETTLE"), help="other lengths of the phases")
    parser.add_argument("--recordings-only", action="store_true", help="train on no rendered rooms, for comparison")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(1)
    recipe = Recipe(with_rendered=not args.recordings_only)
    if args.steps:
        broad, settle = args.steps
        recipe = dataclasses.replace(
            recipe,
            broad=dataclasses.replace(recipe.broad, steps=broad),
            settle=dataclasses.replace(recipe.settle, steps=settle),
        )
    logger.info("weights: %s", make_default_weights(args.data, args.out, recipe, args.watch))


if __name__ == "__main__":
    main()
