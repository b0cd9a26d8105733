"""The shipped weights: ``python -m edgeslam_torch.train.recipes.weights default|near --data DIR --out DIR``.

No recording that figures are quoted of is used; the last weights are kept, not the best on the curve. Each training
resumes where it was killed.
"""

import argparse
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgeslam_torch.models.device import DEVICES
from edgeslam_torch.models.imagenet import load_imagenet_encoder
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.callbacks import ProgressBar
from edgeslam_torch.train.loop import FINAL, train
from edgeslam_torch.train.recipes.rendered_views import Drawn, Rng, place_views, render_files, room_views, stored_views
from edgeslam_torch.train.signals import Source, Supervised, SupervisedWeights
from edgeslam_torch.train.state import TrainConfig
from edgeslam_torch.train.validate import calibrate_sigma, score
from edgeslam_torch.train.views.augment import AugmentConfig, View
from edgeslam_torch.train.views.datasets import load_depth_folder

logger = logging.getLogger(__name__)

RENDERED = "rendered"
"""Among the names of what is learnt from; the others are recordings."""
HELD_OUT_VIEWS = 150
"""First rendered views, of whole places, kept out of training for the curve and the calibration."""
ENCODER = "mobilenet_v1_imagenet/mobilenet_v1_1.0_224_quant_embedding_extractor.tflite"
LICENCE = (
    "Apache-2.0; encoder initialised from google-coral's MobileNetV1 (Apache-2.0); trained on TUM RGB-D freiburg1_rpy "
    "(CC BY 4.0, Sturm et al. 2012), ICL-NUIM living room 1 (CC BY 3.0, Handa et al. 2014) and rooms rendered by this "
    "project"
)

Pools = Mapping[str, Sequence[View]]
"""Views by the name of their source."""
Made = tuple[DepthModule, Metadata]


def default(data: Path, out: Path, device: str) -> Made:
    """Encoder from ImageNet; recordings and rendered rooms mixed, at a constant rate; then fewer rendered rooms and
    gentler augmentation, the rate falling to nothing; sigma calibrated on rooms held out from both.

    Rendered rooms supervise shape only (`metric`): their sizes are invented, and as metric labels they double the error
    in real rooms.
    """
    pools, held_out = _views(data, out, ("tum_fr1_rpy_depth", "icl_livingroom1"), 400, room_views, places=350, seed=7)
    # This size is a third faster than 192x256 and as accurate.
    learnt = ("ImageNet (encoder)", *pools)
    metadata = Metadata(input_height=160, input_width=224, data=learnt, licence=LICENCE)
    torch.manual_seed(0)
    network = build_network(metadata)
    load_imagenet_encoder(network, data / ENCODER)
    broad = Supervised(
        _sources(pools, (0.5, 0.15, 0.35), metric=0.1),
        metadata,
        AugmentConfig(
            zoom=(0.9, 1.4), aspect=0.05, roll_rad=0.12, tilt_rad=0.08, shift=0.1, saturation=0.4, gamma=(0.8, 1.25)
        ),
    )
    config = TrainConfig(
        steps=2200, lr=1e-3, encoder_lr=1.2e-4, lr_end=1.0, validate_every=550, checkpoint_every=100, device=device
    )
    trained = _trained(network, metadata, broad, config, out / "broad", held_out)
    settle = Supervised(
        _sources(pools, (0.65, 0.15, 0.2), metric=0.1),
        metadata,
        AugmentConfig(
            zoom=(0.95, 1.25), aspect=0.04, roll_rad=0.1, tilt_rad=0.05, shift=0.1, saturation=0.4, gamma=(0.8, 1.25)
        ),
    )
    config = replace(config, steps=1000, lr_end=0.01, seed=1, warmup_steps=20, validate_every=500)
    trained = _trained(trained, metadata, settle, config, out / "settle", held_out)
    return trained, calibrate_sigma(trained, metadata, held_out)


def near(data: Path, out: Path, device: str, start: Path | None = None) -> Made:
    """On from given weights with rendered corridors, halls, sites and views from near, beside recordings.

    The result is the mean of the weights before and after, which often does better on places of neither than both ends
    do (Wortsman et al., CVPR 2022). Corridors have true widths, and real ones were estimated half as long as they are.
    """
    names = ("tum_fr1_rpy_depth", "icl_livingroom1", "icsl_corridor", "hololens_a")
    pools, held_out = _views(data, out, names, 320, place_views, places=300, seed=21)
    network, metadata = load_checkpoint(start)
    learnt = tuple(dict.fromkeys((*metadata.data, *pools)))
    metadata = replace(metadata, data=learnt, metrics={}, sigma_scale=1.0, sigma_floor=0.0)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    signal = Supervised(
        _sources(pools, (0.25, 0.1, 0.12, 0.15, 0.5), metric=0.2),
        metadata,
        AugmentConfig(zoom=(0.85, 1.6), aspect=0.06, roll_rad=0.25, gamma=(0.7, 1.4), contrast=0.35, brightness=0.3),
        SupervisedWeights(slope=0.1),
    )
    config = TrainConfig(
        steps=3600, lr=1e-3, encoder_lr=1.5e-4, lr_end=0.03, warmup_steps=20, ema_decay=0.996, seed=5,
        validate_every=500, checkpoint_every=100, device=device,
    )  # fmt: skip
    trained = _trained(network, metadata, signal, config, out / "near", held_out)
    trained.load_state_dict(mean_of(before, trained.state_dict(), 0.5))
    return trained, metadata


def _views(
    data: Path, out: Path, names: Sequence[str], width: int, draw: Callable[[Rng], Drawn], places: int, seed: int
) -> tuple[Pools, list[View]]:
    """Views of recordings, ``width`` pixels wide, and rendered ones; and the rendered ones that are held out."""
    rendered: list[View] = []
    held_out: list[View] = []
    for file in render_files(out / RENDERED, draw, places, seed):
        (rendered if len(held_out) >= HELD_OUT_VIEWS else held_out).extend(stored_views(file))
    return {name: load_depth_folder(data / name, width).views for name in names} | {RENDERED: rendered}, held_out


def _sources(pools: Pools, shares: Sequence[float], metric: float) -> list[Source]:
    """Sources with their parts of the batch, and ``metric`` as the weight of the metres of what is rendered."""
    return [
        Source(name, views, share, metric if name == RENDERED else 1.0)
        for (name, views), share in zip(pools.items(), shares, strict=True)
    ]


def _trained(
    network: DepthModule, metadata: Metadata, signal: Supervised, config: TrainConfig, out: Path, held_out: list[View]
) -> DepthModule:
    def validate(averaged: DepthModule) -> dict[str, float]:
        return score(averaged, metadata, held_out).metrics()

    if not (out / FINAL).is_file():
        train(network, metadata, [signal], config, out, validate, [ProgressBar()])
    return load_checkpoint(out / FINAL)[0]


def mean_of(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor], share: float) -> dict[str, torch.Tensor]:
    """State of ``(1 - share) first + share second``; whole numbers are the first's."""
    if {k: v.shape for k, v in first.items()} != {k: v.shape for k, v in second.items()}:
        raise WeightsError("only weights of one network have a mean: these differ in names or shapes")
    return {k: v.lerp(second[k], share) if v.is_floating_point() else v for k, v in first.items()}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("job", choices=("default", "near"))
    parser.add_argument("--data", type=Path, required=True, help="folder with the recordings")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--weights", type=Path, help="near: to begin with (default: the shipped ones)")
    parser.add_argument("--device", default="auto", choices=DEVICES, help="where it is computed")
    args = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")
    torch.set_num_threads(1)
    given = args.data, args.out, args.device
    network, metadata = default(*given) if args.job == "default" else near(*given, args.weights)
    path = args.out / f"{args.job}.safetensors"
    save_checkpoint(network, metadata, path, half=True)
    logger.info("weights: %s", path)


if __name__ == "__main__":
    main()
