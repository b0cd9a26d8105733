"""The model card's table: ``python -m edgeslam_torch.train.score_weights WEIGHTS... --data FOLDER...``."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from edgeslam_torch.models.checkpoint import load_checkpoint
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import DepthModule
from edgeslam_torch.train.calibrate_sigma import coverage, residuals_and_sigma
from edgeslam_torch.train.validate import score
from edgeslam_torch.train.views.augment import View
from edgeslam_torch.train.views.datasets import load_depth_folder

HEADER = (
    "| weights | recording | images | AbsRel | scaled | RMSE [m] | delta1 | delta1 scaled | AbsRel at edges "
    "| spread of scale | within 1 sigma | within 1.96 sigma |"
)


def table_row(name: str, network: DepthModule, metadata: Metadata, recording: str, views: Sequence[View]) -> str:
    """One line of the table for views with depth."""
    s = score(network, metadata, views)
    residuals, raw = residuals_and_sigma(network, metadata, views)
    one, two = coverage(residuals, np.hypot(metadata.sigma_scale * raw, metadata.sigma_floor))
    return (
        f"| {name} | {recording} | {len(views)} | {s.abs_rel:.3f} | {s.abs_rel_scaled:.3f} | {s.rmse_m:.3f} "
        f"| {s.delta1:.3f} | {s.delta1_scaled:.3f} | {s.abs_rel_edges:.3f} | {s.log_scale_std:.3f} "
        f"| {one:.2f} | {two:.2f} |"
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("weights", nargs="*", type=Path, help="default: the shipped weights")
    parser.add_argument("--data", nargs="+", type=Path, required=True, help="recordings with depth, TUM layout")
    parser.add_argument("--stride", type=int, default=1, help="every n-th depth map")
    parser.add_argument("--skip", type=int, default=0, help="leave out the first depth maps")
    args = parser.parse_args()
    torch.set_num_threads(1)
    lines = [HEADER, "|---" * (HEADER.count("|") - 1) + "|"]
    for folder in args.data:
        views = load_depth_folder(folder, width=640).views[args.skip :: args.stride]
        for path in args.weights or [None]:
            network, metadata = load_checkpoint(path)
            lines.append(table_row(path.name if path else "shipped", network, metadata, folder.name, views))
    print("\n".join(lines))  # noqa: T201 - this is a command


if __name__ == "__main__":
    main()
