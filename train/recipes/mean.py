"""Mean of weights: ``python -m edgeslam_torch.train.recipes.mean A B --share 0.5 --out FILE``.

Between weights and what they became by learning more, the mean often does better on places of neither than both ends do
(Wortsman et al., CVPR 2022).
"""

import argparse
import dataclasses
from pathlib import Path

import torch

from edgeslam_torch.errors import WeightsError
from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.models.fastdepth import FastDepth


def mean_of(first: FastDepth, second: FastDepth, share: float) -> dict[str, torch.Tensor]:
    """State of ``(1 - share) first + share second``; whole numbers are the first's.

    Raises:
        WeightsError: If they are not the same network.
    """
    one, other = first.state_dict(), second.state_dict()
    if {k: v.shape for k, v in one.items()} != {k: v.shape for k, v in other.items()}:
        raise WeightsError("only weights of one network have a mean: these differ in names or shapes")
    return {k: v.lerp(other[k], share) if v.is_floating_point() else v for k, v in one.items()}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", help="weights, or 'shipped'; the record is theirs")
    parser.add_argument("second", type=Path)
    parser.add_argument("--share", type=float, default=0.5, help="of the second")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    network, metadata = load_checkpoint(None if args.first == "shipped" else Path(args.first))
    other, learnt = load_checkpoint(args.second)
    network.load_state_dict(mean_of(network, other, args.share))
    names = tuple(dict.fromkeys((*metadata.data, *learnt.data)))
    save_checkpoint(network, dataclasses.replace(metadata, data=names, metrics={}), args.out, half=True)


if __name__ == "__main__":
    main()
