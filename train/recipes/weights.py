"""The shipped weights: ``python -m edgeslam_torch.train.recipes.weights default|near --data DIR --out DIR``.

``default.toml`` and ``near.toml`` say what is learnt from, in which phases. No recording that figures are quoted of is
used; the last weights are kept, not the best on the curve.
"""

import argparse
import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch

from edgeslam_torch.errors import ConfigError, WeightsError
from edgeslam_torch.files.config_file import laid_over
from edgeslam_torch.files.record_files import read_mapping
from edgeslam_torch.models.checkpoint import build_network, load_checkpoint, save_checkpoint
from edgeslam_torch.models.device import DEVICES
from edgeslam_torch.models.imagenet import load_imagenet_encoder
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.callbacks import ProgressBar
from edgeslam_torch.train.loop import FINAL, train
from edgeslam_torch.train.recipes.rendered_views import place_views, render_files, room_views, stored_views
from edgeslam_torch.train.signals import Source, Supervised, SupervisedWeights
from edgeslam_torch.train.state import TrainConfig
from edgeslam_torch.train.validate import calibrate_sigma, score
from edgeslam_torch.train.views.augment import AugmentConfig, View
from edgeslam_torch.train.views.datasets import load_depth_folder

logger = logging.getLogger(__name__)

RENDERED = "rendered"
"""Among the names of what a phase draws from; the others are recordings."""
HELD_OUT_VIEWS = 150
"""First rendered views, of whole places, kept out of training for the curve and the calibration."""


@dataclass(frozen=True, slots=True)
class Phase:
    """One training."""

    name: str = ""
    metric: float = 1.0
    """Weight of the metres of what is rendered."""
    config: TrainConfig = field(default_factory=TrainConfig)
    augment: AugmentConfig = field(default_factory=AugmentConfig)
    weights: SupervisedWeights = field(default_factory=SupervisedWeights)
    shares: dict[str, float] = field(default_factory=dict)
    """Parts of the batch by source, relative to each other."""


@dataclass(frozen=True, slots=True)
class Job:
    """What makes one file of weights."""

    views: Literal["rooms", "places"] = "rooms"
    places: int = 0
    """How many are rendered, drawn by `seed`."""
    seed: int = 0
    width: int = 400
    """Of the recordings' images [px]."""
    input_size: tuple[int, int] | None = None
    """Height and width [px] of a new network; None goes on from given weights."""
    encoder: str = ""
    """File in the data's folder that a new network's encoder begins with."""
    licence: str = ""
    calibrate: bool = False
    """Whether sigma is calibrated in the end."""
    mean_share: float = 1.0
    """Of the weights after the training, in their mean with those before."""
    phase: tuple[Phase, ...] = ()


def read_job(name: str) -> Job:
    """``default`` or ``near``."""
    path = Path(__file__).with_name(f"{name}.toml")
    table = read_mapping(path, "TOML", ConfigError)
    phases = [_phase(entry, str(path)) for entry in table.pop("phase")]
    return replace(laid_over(Job(), table, str(path)), phase=tuple(phases))


def _phase(table: dict[str, Any], origin: str) -> Phase:
    shares = table.pop("shares")
    return replace(laid_over(Phase(), table, origin), shares=shares)


def make(job: Job, data: Path, out: Path, start: Path | None, device: str) -> tuple[DepthModule, Metadata]:
    """Run all phases; each resumes where it was killed. Returns the finished network and its record.

    Args:
        job: Which.
        data: Folder with the recordings and the encoder.
        out: Folder for everything.
        start: Weights to go on from; the shipped ones by default.
        device: Where it is computed.
    """
    names = [name for phase in job.phase for name in phase.shares]
    draw = {"rooms": room_views, "places": place_views}[job.views]
    pools: dict[str, Any] = {RENDERED: []}
    held_out: list[View] = []
    for file in render_files(out / RENDERED, draw, job.places, job.seed):
        (pools[RENDERED] if len(held_out) >= HELD_OUT_VIEWS else held_out).extend(stored_views(file))
    pools |= {name: load_depth_folder(data / name, job.width).views for name in {*names} - {RENDERED}}
    if job.input_size is not None:
        height, width = job.input_size
        learnt = dict.fromkeys(("ImageNet (encoder)", *names))
        metadata = Metadata(input_height=height, input_width=width, data=tuple(learnt), licence=job.licence)
        torch.manual_seed(0)
        new = build_network(metadata)
        load_imagenet_encoder(new, data / job.encoder)
        network: DepthModule = new
    else:
        network, metadata = load_checkpoint(start)
        learnt = dict.fromkeys((*metadata.data, *names))
        metadata = replace(metadata, data=tuple(learnt), metrics={}, sigma_scale=1.0, sigma_floor=0.0)

    def validate(averaged: DepthModule) -> dict[str, float]:
        return score(averaged, metadata, held_out).metrics()

    before = {name: value.clone() for name, value in network.state_dict().items()}
    for phase in job.phase:
        sources = [
            Source(name, pools[name], share, phase.metric if name == RENDERED else 1.0)
            for name, share in phase.shares.items()
        ]
        signal = Supervised(sources, metadata, phase.augment, phase.weights)
        config, folder = replace(phase.config, device=device), out / phase.name
        if not (folder / FINAL).is_file():
            train(network, metadata, [signal], config, folder, validate, [ProgressBar()])
        network = load_checkpoint(folder / FINAL)[0]
    if job.mean_share < 1:
        network.load_state_dict(mean_of(before, network.state_dict(), job.mean_share))
    return network, calibrate_sigma(network, metadata, held_out) if job.calibrate else metadata


def mean_of(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor], share: float) -> dict[str, torch.Tensor]:
    """State of ``(1 - share) first + share second``; whole numbers are the first's.

    Raises:
        WeightsError: If they are not of the same network.
    """
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
    network, metadata = make(read_job(args.job), args.data, args.out, args.weights, args.device)
    path = args.out / f"{args.job}.safetensors"
    save_checkpoint(network, metadata, path, half=True)
    logger.info("weights: %s", path)


if __name__ == "__main__":
    main()
