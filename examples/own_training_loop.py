"""The losses in a training loop of one's own: own data set, own `DataLoader`, own optimiser, any device.

    edgeslam run FLIGHT --out run
    python own_training_loop.py run --out mine.safetensors
    edgeslam run FLIGHT --out again --depth mine.safetensors

It fine-tunes the shipped network on a run's images, two at a time, by map points, photometry and the edge cycle. Any
network from images ``(B, 3, H, W)`` to log depth ``(B, 1, H, W)`` can stand in `log_depth`; the losses are explained in
``docs/guides/your-own-loop.md``. ``edgeslam finetune`` does more (measured depth, validation, resumes).
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from edgeslam_torch.losses import CycleLoss, Kernel, MaskedL1, PhotometricLoss, SmoothnessLoss, TotalLoss, sample_depth
from edgeslam_torch.models.checkpoint import load_checkpoint, save_checkpoint
from edgeslam_torch.models.fastdepth import FastDepth
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.train import PosedSequence, PosedView, View, edge_pixels, fitted_view, load_run, relative_motion

POINTS, EDGES = 500, 600
"""Map points and edge pixels per image."""


class Pairs(Dataset[dict[str, Tensor]]):
    """Two images of one place, what lies between them, and the map points that the first one sees."""

    def __init__(self, run: PosedSequence, metadata: Metadata) -> None:
        self.run, self.metadata, self.first = run, metadata, run.usable

    def __len__(self) -> int:
        """Images that have a partner."""
        return len(self.first)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """Tensors of fixed sizes: fewer points are padded with NaN, which no loss counts."""
        i = self.first[index]
        one, other = self.run.views[i], self.run.views[self.run.partners[i][0]]
        image_i, K = self._fitted(one)
        image_j, _ = self._fitted(other)
        uv, z = np.full((POINTS, 2), np.nan, np.float32), np.zeros(POINTS, np.float32)
        pick = np.random.default_rng(index).permutation(len(one.z))[:POINTS]
        to_network = K @ np.linalg.inv(one.K)
        uv[: len(pick)] = one.uv[pick] @ to_network[:2, :2].T + to_network[:2, 2]
        z[: len(pick)] = one.z[pick]
        return {
            "image_i": image_i,
            "image_j": image_j,
            "K": torch.from_numpy(K).float(),
            "T_j_i": torch.from_numpy(relative_motion(one, other)).float(),
            "uv": torch.from_numpy(uv),
            "z": torch.from_numpy(z),
        }

    def _fitted(self, view: PosedView) -> tuple[Tensor, np.ndarray]:
        """RGB in [0, 1] at the network's size, and its calibration matrix."""
        size = (self.metadata.input_height, self.metadata.input_width)
        small = fitted_view(View(view.image, np.zeros(view.image.shape[:2], np.float32), view.K), size)
        rgb = np.ascontiguousarray(small.image[..., ::-1].transpose(2, 0, 1))
        return torch.from_numpy(rgb).float() / 255.0, small.K


class Losses(torch.nn.Module):
    """What the loop minimises, one value a pair."""

    def __init__(self) -> None:
        super().__init__()
        self.total = TotalLoss({"points": 1.0, "photometric": 0.3, "cycle": 0.5, "smooth": 0.1})
        self.points, self.photometric, self.smooth = MaskedL1(), PhotometricLoss(), SmoothnessLoss()
        self.cycle = CycleLoss(kernel=Kernel.HUBER, delta=0.05)

    def forward(self, log_i: Tensor, log_j: Tensor, batch: dict[str, Tensor]) -> Tensor:
        """``(B,)`` of log depths ``(B, 1, H, W)`` [log m] of both images."""
        depth_i, depth_j, T_j_i, K = log_i.exp(), log_j.exp(), batch["T_j_i"], batch["K"]
        at_points, inside = sample_depth(depth_i[:, 0], batch["uv"])
        known = inside & (batch["z"] > 0)
        edges = edge_pixels(batch["image_i"], EDGES)
        at_edges, on_image = sample_depth(depth_i[:, 0], edges)
        terms = {
            "points": self.points(at_points.clamp_min(1e-3).log(), batch["z"].clamp_min(1e-3).log(), known),
            "photometric": self.photometric(batch["image_i"], batch["image_j"][:, None], depth_i, T_j_i[:, None], K),
            "cycle": self.cycle(T_j_i, edges, at_edges.where(on_image, 0.0), depth_j[:, 0], K),
            "smooth": self.smooth(log_i, batch["image_i"]),
        }
        return self.total(terms)


def log_depth(network: FastDepth, metadata: Metadata, rgb: Tensor, K: Tensor) -> Tensor:
    """Log depth [log m] ``(B, 1, H, W)``: the network's, for the focal length that took the images."""
    mean, std = (torch.tensor(x, device=rgb.device).view(3, 1, 1) for x in (metadata.mean, metadata.std))
    focal = (K[:, 0, 0] * K[:, 1, 1]).sqrt()
    return network.predict((rgb - mean) / std).log_depth + (focal / metadata.focal_px).log().view(-1, 1, 1, 1)


def train(args: argparse.Namespace) -> None:
    """The loop."""
    torch.manual_seed(args.seed)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network, metadata = load_checkpoint(args.weights)
    network.to(device)  # in evaluation mode: batch norm keeps its statistics, right for little data
    pairs = Pairs(load_run(args.run), metadata)
    loader = DataLoader(pairs, args.batch, shuffle=True, drop_last=True, num_workers=args.workers)
    losses, optimiser = Losses(), torch.optim.AdamW(network.parameters(), lr=args.lr)
    for epoch in range(args.epochs):
        values = []
        for cpu_batch in loader:
            batch = {name: x.to(device) for name, x in cpu_batch.items()}
            with torch.autocast(device.type, torch.bfloat16, enabled=args.amp):
                log_i = log_depth(network, metadata, batch["image_i"], batch["K"])
                log_j = log_depth(network, metadata, batch["image_j"], batch["K"])
            value: Tensor = losses(log_i, log_j, batch).mean()
            optimiser.zero_grad()
            value.backward()
            torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
            optimiser.step()
            values.append(float(value.detach()))
        print(f"epoch {epoch + 1}: loss {np.mean(values):.4f} over {len(values)} steps", flush=True)
    save_checkpoint(network.cpu(), metadata, args.out, half=True)


def main() -> None:
    """Read the options and train."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="output folder of 'edgeslam run'")
    parser.add_argument("--out", type=Path, required=True, help="weights to write")
    parser.add_argument("--weights", type=Path, help="weights to start from (default: the shipped ones)")
    parser.add_argument("--epochs", type=int, default=2)
    parser.add_argument("--batch", type=int, default=4)
    parser.add_argument("--workers", type=int, default=2, help="processes that prepare images")
    parser.add_argument("--lr", type=float, default=3e-5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--amp", action="store_true", help="bfloat16 in the network; losses stay in float32")
    train(parser.parse_args())


if __name__ == "__main__":
    main()
