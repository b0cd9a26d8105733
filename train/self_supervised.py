"""Self-supervision from a SLAM run: photometric reprojection, map points, edge cycle, L-shapes."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from edgeslam_torch.losses.base import Reduction, back_project, move, project
from edgeslam_torch.losses.cycle import CycleForm, CycleLoss
from edgeslam_torch.losses.depth_terms import LaplaceNll, masked_mean
from edgeslam_torch.losses.lshape import AngleLoss, CollinearityLoss, LShapeLoss
from edgeslam_torch.losses.photometric import PhotometricLoss, SmoothnessLoss
from edgeslam_torch.losses.robust import Kernel
from edgeslam_torch.losses.sampling import sample
from edgeslam_torch.losses.total import TotalLoss
from edgeslam_torch.models.record import Metadata
from edgeslam_torch.models.trainable import Prediction
from edgeslam_torch.train.signals import Slot
from edgeslam_torch.train.validate import image_tensor
from edgeslam_torch.train.views.augment import AugmentConfig, View, recolour, scaled_K, warp
from edgeslam_torch.train.views.edges import junction_points, seen_cosines, straight_edges
from edgeslam_torch.train.views.posed import PosedSequence, PosedView, relative_motion
from edgeslam_torch.types import FloatArray

EDGES = 600
"""Edge pixels per image in the cycle."""
ARMS, ARM_POINTS = 24, 8
"""Straight edges per image and points on each."""
JUNCTIONS = 24
"""L-junctions per image."""
SPARSE = 1500
"""Map points per image."""
FLIP = 0.5
"""Probability of mirroring a pair."""
CLIP_LOG = 0.5
"""Map points farther than this from the prediction (65 %) are treated as occluded or wrong: constant cost."""


@dataclass(frozen=True, slots=True)
class SelfSupervisedWeights:
    """Weights of the terms; 0 leaves one out."""

    photometric: float = 0.3
    points: float = 1.0
    cycle: float = 0.5
    lshape: float = 0.1
    smooth: float = 0.1
    uncertainty: float = 0.1


@dataclass
class SelfSupervised:
    """Pairs of posed frames without depth labels.

    The scale is the run's: its map points and baselines are in metres when telemetry or the network gave
    it metres.
    A run in arbitrary units is scaled to metres by ``log_scale``, which fits the network's own depth.
    """

    sequences: Sequence[PosedSequence]
    metadata: Metadata
    log_scale: Sequence[float] = ()
    """Per sequence: log of metres per unit."""
    zoom: tuple[float, float] = (1.0, 1.4)
    augment: AugmentConfig = field(default_factory=lambda: replace(AugmentConfig(), blur=0.1, noise=0.1))
    weights: SelfSupervisedWeights = field(default_factory=SelfSupervisedWeights)
    name: str = "self"

    def __post_init__(self) -> None:
        self._items = [(s, i) for s, sequence in enumerate(self.sequences) for i in sequence.usable]
        self._scale = list(self.log_scale) or [0.0] * len(self.sequences)
        self._photometric, self._smooth, self._nll = PhotometricLoss(), SmoothnessLoss(), LaplaceNll()
        self._cycle = CycleLoss(CycleForm.RELATIVE_DEPTH, Reduction.MEAN, Kernel.HUBER, delta=0.05)
        angle = AngleLoss(kernel=Kernel.HUBER, delta=0.2)
        self._lshape = LShapeLoss(angle, CollinearityLoss(kernel=Kernel.HUBER, delta=0.05))

    def draw(self, slots: Sequence[Slot]) -> tuple[dict[str, Tensor], list[str]]:
        """Normalised inputs of view i and of its first partner (``image``, stacked), and the targets of the
        losses; ``sequence/image`` of each slot."""
        samples, names = zip(*(self._sample(slot) for slot in slots), strict=True)
        batch = {key: torch.stack([s[key] for s in samples]) for key in samples[0]}
        batch["image"] = torch.cat((batch.pop("input_i"), batch.pop("input_j")))
        return batch, list(names)

    def losses(self, predicted: Prediction, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Weighted terms, each ``(B,)``."""
        w = self.weights
        shift = batch["log_focal"].view(-1, 1, 1, 1)
        B = shift.shape[0]
        log_i = predicted.log_depth[:B].float() + shift
        log_j = predicted.log_depth[B:].float() + shift
        K, T = batch["K"], batch["T_j_i"]
        terms: dict[str, Tensor] = {}
        if w.photometric:
            terms["photometric"] = self._photometric(batch["rgb_i"], batch["rgb_j"], log_i.exp(), T, K)
        at_points = _at(log_i, batch["uv"])
        residual = at_points - batch["log_z"]
        near = batch["known"] & (residual.detach().abs() < CLIP_LOG)
        if w.points:
            # Residuals are clipped to a constant beyond the limit, so that larger errors do not lower the loss.
            terms["points"] = masked_mean(residual.abs().clamp(max=CLIP_LOG), batch["known"])
        if w.cycle:
            edges = batch["edges"]
            terms["cycle"] = self._cycle(T[:, 0], edges, _depth_at(log_i, edges), log_j[:, 0].exp(), K)
        if w.lshape:
            terms["lshape"] = self._lshape_term(log_i, batch)
        if w.smooth:
            terms["smooth"] = self._smooth(log_i, batch["rgb_i"])
        if predicted.log_sigma is not None and w.uncertainty:
            sigma = _at(predicted.log_sigma[:B].float(), batch["uv"])
            terms["uncertainty"] = self._nll(sigma, at_points, batch["log_z"], near)
        return TotalLoss(asdict(w)).weighted(terms)

    def _lshape_term(self, log_i: Tensor, batch: dict[str, Tensor]) -> Tensor:
        T, K, arms, corners = batch["T_j_i"][:, 0], batch["K"], batch["arms"], batch["junctions_i"]
        depth = _depth_at(log_i, corners)
        with torch.no_grad():
            p_i = back_project(corners.flatten(1, 2), depth.flatten(1), K)
            projected = project(move(T, p_i), K)[0].unflatten(1, corners.shape[1:3])
            cos_j = torch.stack([seen_cosines(*pair) for pair in zip(projected, batch["junctions_j"], strict=True)])
        shape = (len(arms), -1, 2, ARM_POINTS)
        on_arms = back_project(arms.flatten(1, 2), _depth_at(log_i, arms).flatten(1), K).reshape(*shape, 3)
        return self._lshape(T, corners, depth, cos_j, K, on_arms, (arms[..., 0] >= 0).reshape(shape))

    def _sample(self, slot: Slot) -> tuple[dict[str, Tensor], str]:
        rng = slot.rng()
        s, i = self._items[int(rng.integers(len(self._items)))]
        sequence, scale = self.sequences[s], float(np.exp(self._scale[s]))
        view = sequence.views[i]
        partners = rng.choice(sequence.partners[i], 2)
        others = [sequence.views[int(j)] for j in partners]
        size = (self.metadata.input_height, self.metadata.input_width)
        K = _zoomed(view, size, self.zoom, rng)
        images = [_seen(v, K, size) for v in (view, *others)]
        motions = np.stack([relative_motion(view, v) for v in others])
        motions[:, :3, 3] *= scale
        flip = bool(rng.random() < FLIP)
        to_crop = K @ np.linalg.inv(view.K)
        uv = view.uv @ to_crop[:2, :2].T + to_crop[:2, 2]
        if flip:
            images = [np.ascontiguousarray(x[:, ::-1]) for x in images]
            mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
            motions = mirror @ motions @ mirror
            K[0, 2] = size[1] - 1 - K[0, 2]
            uv = uv * (-1, 1) + (size[1] - 1, 0)
        points, z = _inside(uv, view.z * scale, size, rng)
        edges, arms = straight_edges(images[0], EDGES, ARMS, ARM_POINTS, rng)
        seed = int(rng.integers(1 << 62))
        # Both images of a pair get the same colour change; the photometric term sees the originals.
        inputs = [recolour(x, self.augment, np.random.default_rng(seed)) for x in images[:2]]
        focal = float(np.sqrt(K[0, 0] * K[1, 1]))
        return {
            "input_i": image_tensor(inputs[0], self.metadata),
            "input_j": image_tensor(inputs[1], self.metadata),
            "rgb_i": _rgb(images[0]),
            "rgb_j": torch.stack([_rgb(x) for x in images[1:]]),
            "K": torch.from_numpy(K).float(),
            "T_j_i": torch.from_numpy(motions).float(),
            "log_focal": torch.tensor(np.log(focal / self.metadata.focal_px), dtype=torch.float32),
            "uv": torch.from_numpy(points),
            "log_z": torch.from_numpy(np.log(np.maximum(z, 1e-3))),
            "known": torch.from_numpy(z > 0),
            "edges": torch.from_numpy(edges),
            "arms": torch.from_numpy(arms),
            "junctions_i": torch.from_numpy(junction_points(images[0], JUNCTIONS)),
            "junctions_j": torch.from_numpy(junction_points(images[1], JUNCTIONS)),
        }, f"{sequence.name}/{view.name}"


def _zoomed(view: PosedView, size: tuple[int, int], zoom: tuple[float, float], rng: np.random.Generator) -> FloatArray:
    height, width = size
    h, w = view.image.shape[:2]
    factor = float(np.exp(rng.uniform(*np.log(zoom))))
    K = scaled_K(view.K, width / w * factor, height / h * factor)
    room_x, room_y = (factor - 1) * width, (factor - 1) * height
    K[0, 2] -= rng.uniform(0, room_x)
    K[1, 2] -= rng.uniform(0, room_y)
    return K


def _seen(view: PosedView, K: FloatArray, size: tuple[int, int]) -> NDArray[np.uint8]:
    return warp(View.without_depth(view.image, view.K), K, np.eye(3), size).image


def _inside(
    uv: FloatArray, z: FloatArray, size: tuple[int, int], rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """``SPARSE`` points inside the image, padded with depth 0."""
    height, width = size
    kept = np.flatnonzero(((uv >= 0) & (uv <= (width - 1, height - 1))).all(1))
    if len(kept) > SPARSE:
        kept = rng.choice(kept, SPARSE, replace=False)
    out_uv, out_z = np.zeros((SPARSE, 2), np.float32), np.zeros(SPARSE, np.float32)
    out_uv[: len(kept)], out_z[: len(kept)] = uv[kept], z[kept]
    return out_uv, out_z


def _rgb(image: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image[..., ::-1].transpose(2, 0, 1))).float() / 255.0


def _depth_at(log_depth: Tensor, uv: Tensor) -> Tensor:
    """Depths ``(B, ...)`` of ``(B, 1, H, W)`` at pixels ``(B, ..., 2)``; 0, which the losses leave out, at padding
    (-1)."""
    depth = _at(log_depth, uv.flatten(1, -2)).exp().reshape(uv.shape[:-1])
    return torch.where(uv[..., 0] >= 0, depth, 0.0)


def _at(maps: Tensor, uv: Tensor) -> Tensor:
    """Bilinear samples ``(B, N)`` of ``(B, 1, H, W)`` at pixels ``(B, N, 2)``."""
    size = maps.new_tensor((maps.shape[-1] - 1, maps.shape[-2] - 1))
    grid = (2.0 * uv / size - 1.0)[:, None]
    return sample(maps, grid)[:, 0, 0]
