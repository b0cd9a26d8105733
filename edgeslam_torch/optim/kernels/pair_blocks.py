"""Blocks anchored in a host pose and observed from target poses: what edges and junctions share.

Residuals are differentiated by the *relative* pose of host and target, six columns, whatever the window's size;
blocks are eliminated in those columns, one dense product per tile of blocks (`optim.kernels.tiles`); only then does the
adjoint map them to the two poses: ``xi_rel = xi_target - Ad(T_target_host) xi_host``. docs/theory/window.md derives it.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.geometry import se3_torch as lie
from edgeslam_torch.losses.robust import Kernel, rho
from edgeslam_torch.optim.kernels import schur
from edgeslam_torch.optim.kernels.compiled import kernel
from edgeslam_torch.optim.kernels.tiles import lay_out
from edgeslam_torch.optim.problem import LmConfig
from edgeslam_torch.types import FloatArray, IntArray

INVERSE_DEPTH_MIN = 1e-4
"""Lower bound of refined inverse depths: practically at infinity, never behind the camera."""


class RelativeSystem(NamedTuple):
    """Normal equations of blocks at one state."""

    V: Tensor
    """Upper triangles of the blocks ``(size (size + 1) / 2, B, L)``."""
    g: Tensor
    """Their gradients ``(size, B, L)``."""
    cross: Tensor
    """Their coupling with the relative poses ``(B, T, 6, size, L)``."""
    map: Tensor
    """Tangents of the relative poses by those of the free poses ``(B, 6 T, 6 F)``."""


class Eliminated(NamedTuple):
    """Blocks eliminated from the pose system, for back-substitution."""

    factor: Tensor
    """Inverse Cholesky factors, shaped as `RelativeSystem.V`."""
    y: Tensor
    """Whitened gradients ``(size, B, L)``."""
    Y_T: Tensor
    """``(B, size L, 6 T)``."""


class Robust(NamedTuple):
    """How the squares of whitened residuals count."""

    far: Tensor
    """``(B, T, L)`` square of a pair that lies behind a camera; zero where there is no pair."""
    kernel: Kernel
    delta: float
    """Width of the kernel [standard deviations]."""


class Layout(NamedTuple):
    """Tiles and the poses they belong to."""

    host: Tensor
    """``(B,)`` hosts."""
    target: Tensor
    """``(B, T)`` targets."""
    host_column: Tensor
    """``(B,)`` free-pose numbers of the hosts, ``F`` for a fixed pose."""
    target_column: Tensor
    """``(B T,)`` the same of the targets."""
    free: int
    """``F``."""
    dtype: torch.dtype
    """Of the blocks."""


class Weighed(NamedTuple):
    """Weighted rows of all pairs, summed up; see `schur.pair_products` for the first four."""

    normal: Tensor
    cross: Tensor
    V: Tensor
    g: Tensor
    cost: Tensor
    """``()``."""


class Known(NamedTuple):
    """Priors on the blocks, at one state."""

    V: Tensor
    """Information, as upper triangles ``(size (size + 1) / 2, B, L)``."""
    g: Tensor
    """Gradients ``(size, B, L)``."""
    cost: Tensor
    """``()``."""


class Prior(Protocol):
    """Prior on the blocks."""

    def at(self, x: Tensor) -> Known:
        """At blocks ``(size, B, L)``."""


class Linearised(NamedTuple):
    """A `RelativeSystem`, and what it adds to the pose system."""

    system: RelativeSystem
    H: Tensor
    """``(6F, 6F)``."""
    g: Tensor
    """``(6F,)``."""
    cost: Tensor
    """``()``."""


class RelativeBlocks(ABC):
    """Host-anchored blocks of ``size`` inverse depths; subclasses write the residual rows.

    Pairs are kept in tiles: ``B`` tiles of ``T`` targets by ``L`` blocks, values of blocks ``(size, B, L)``.
    """

    size: int
    system_kernel: Callable[..., Linearised]
    """Normal equations at poses ``(W, 4, 4)`` and blocks ``(size, B, L)``, given layout, prior and pairs."""
    cost_kernel: Callable[..., Tensor]
    """Robust cost ``()`` of the rows at motions ``(3, 4, B, T, 1)`` and blocks, given pairs."""
    prior: Prior
    pairs: NamedTuple
    """Blocks and what the views that see them measured, in tiles."""
    compiles: ClassVar[bool] = True
    """Whether there are enough of them to pay for compiled kernels."""

    def __init__(
        self,
        host: IntArray,
        pair_block: IntArray,
        pair_pose: IntArray,
        inverse_depth: FloatArray,
        column: Tensor,
        config: LmConfig,
        dtype: torch.dtype,
    ) -> None:
        """Lay out.

        Args:
            host: ``(E,)`` host poses.
            pair_block: ``(P,)`` blocks of the pairs.
            pair_pose: ``(P,)`` target poses.
            inverse_depth: ``(size, E)`` start.
            column: ``(W,)`` free-pose number of each pose, -1 for a fixed one.
            config: Kernel and its width.
            dtype: Of the blocks.
        """
        self.config, self.dtype = config, dtype
        self.compile = config.compile and self.compiles
        self.tiles = lay_out(host, pair_block, pair_pose, len(column))
        self.x = self.tiles.blocks(np.maximum(inverse_depth, INVERSE_DEPTH_MIN), torch.float64, 1.0)
        # Cost of a pair behind a camera; empty slots cost nothing.
        self.far = self.tiles.pairs(np.full(len(pair_block), config.behind_px**2), dtype)
        F = int((column >= 0).sum())
        column = torch.where(column < 0, F, column)  # fixed poses share a last column that is cut off
        self.layout = Layout(
            self.tiles.host, self.tiles.target, column[self.tiles.host], column[self.tiles.target].flatten(), F, dtype
        )

    def system(self, T_c_w: Tensor, x: Tensor) -> Linearised:
        """Normal equations at poses ``(W, 4, 4)`` and blocks ``(size, B, L)``."""
        linear = kernel(self.system_kernel, self.compile)
        out: Linearised = linear(T_c_w, x, self.layout, self.prior, self.pairs)
        return out

    def robust_cost(self, Rt: Tensor, x: Tensor) -> Tensor:
        """Robust cost ``()`` of the residual rows, at motions ``(3, 4, B, T, 1)``."""
        out: Tensor = kernel(self.cost_kernel, self.compile)(Rt, x, self.pairs)
        return out

    @abstractmethod
    def prior_cost(self, x: Tensor) -> Tensor:
        """Cost ``()`` of the priors on the blocks ``(size, B, L)``."""

    def motions(self, T_c_w: Tensor) -> tuple[Tensor, Tensor]:
        """Relative motions ``(B T, 4, 4)``, and in the blocks' precision ``(3, 4, B, T, 1)``."""
        motions = kernel(relative_motions, self.compile)
        out: tuple[Tensor, Tensor] = motions(T_c_w, self.tiles.host, self.tiles.target, self.dtype)
        return out

    def cost(self, T_c_w: Tensor, x: Tensor) -> Tensor:
        """Robust cost ``()``."""
        return self.robust_cost(self.motions(T_c_w)[1], x.to(self.dtype)) + self.prior_cost(x)

    def linearise(self, T_c_w: Tensor, x: Tensor, H: Tensor, g: Tensor) -> tuple[RelativeSystem, Tensor]:
        """Normal equations and cost ``()``; adds the poses' own part to ``H (6F, 6F)`` and ``g (6F,)``."""
        linear = self.system(T_c_w, x)
        H += linear.H
        g += linear.g
        return linear.system, linear.cost

    def reduce(self, system: RelativeSystem, mu: float, S: Tensor, b: Tensor) -> Eliminated:
        """Eliminate the blocks from the pose system ``S`` and its right side ``b``."""
        damping = torch.tensor(mu, dtype=torch.float64)
        eliminated, taken, right = kernel(taken_out, self.compile)(system, damping)
        S -= taken
        b -= right
        out: Eliminated = eliminated
        return out

    def step(self, system: RelativeSystem, eliminated: Eliminated, delta: Tensor) -> Tensor:
        """Back-substitution: step of the blocks ``(size, B, L)`` for the poses' ``delta (6F,)``."""
        B, _, L = self.tiles.shape
        moved = (eliminated.Y_T @ (system.map @ delta).to(self.dtype)[..., None]).view(B, self.size, L)
        return schur.unwhiten(eliminated.factor, -eliminated.y - moved.transpose(0, 1))

    def robust(self) -> Robust:
        """How the squares of the residuals count."""
        return Robust(self.far, self.config.kernel, self.config.edge_delta)


def relative_motions(T_c_w: Tensor, host: Tensor, target: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """See `RelativeBlocks.motions`; poses ``(W, 4, 4)``, hosts ``(B,)`` and targets ``(B, T)``."""
    T = T_c_w[target] @ lie.inverse(T_c_w)[host, None]
    return T.flatten(0, 1), T[..., :3, :].permute(2, 3, 0, 1)[..., None].to(dtype).contiguous()


def taken_out(system: RelativeSystem, damping: Tensor) -> tuple[Eliminated, Tensor, Tensor]:
    """Eliminated blocks, and the Schur terms to subtract from the pose system ``(6F, 6F)`` and its right side."""
    factor, y, Y_T, taken, right = schur.eliminate(system.V, system.g, system.cross, damping)
    flat = system.map.flatten(0, 1)
    return Eliminated(factor, y, Y_T), flat.mT @ (taken @ system.map).flatten(0, 1), flat.mT @ right.flatten()


def mapped(T_rel: Tensor, normal: Tensor, host: Tensor, target: Tensor, F: int) -> tuple[Tensor, Tensor, Tensor]:
    """Normal equations of the relative poses, mapped to the free poses.

    Args:
        T_rel: Relative motions ``(B T, 4, 4)``.
        normal: Their normal matrices and gradients ``(B, T, 7, 7)``.
        host: Free-pose numbers ``(B,)`` of the hosts, ``F`` for a fixed pose.
        target: The same of the targets ``(B T,)``.
        F: Number of free poses.

    Returns:
        Tangents of the relative poses by those of the free poses ``(B, 6 T, 6 F)``, and what to add to the pose
        system ``(6 F, 6 F)`` and its gradient ``(6 F,)``.
    """
    B, T = normal.shape[:2]
    G, n = B * T, 6 * F
    numbers = torch.arange(F, device=host.device)
    of_host = host[:, None, None].expand(B, T, F).reshape(G, F) == numbers
    by_host = of_host[:, None, :, None] * lie.adjoint(T_rel)[:, :, None]
    eye = torch.eye(6, dtype=T_rel.dtype, device=host.device)
    by_target = (target[:, None] == numbers)[:, None, :, None] * eye[:, None]
    M = (by_target - by_host).view(G, 6, n)
    flat, N = M.view(6 * G, n), normal.double().view(G, 7, 7)
    H = flat.mT @ (N[:, :6, :6] @ M).view(6 * G, n)
    return M.view(B, 6 * T, n), H, flat.mT @ N[:, :6, 6].flatten()


def as_system(T_rel: Tensor, layout: Layout, weighed: Weighed, known: Known) -> Linearised:
    """Rows and prior knowledge as normal equations; ``T_rel`` are the relative motions ``(B T, 4, 4)``."""
    to_relative, H, g_pose = mapped(T_rel, weighed.normal, layout.host_column, layout.target_column, layout.free)
    system = RelativeSystem(weighed.V.double() + known.V, weighed.g.double() + known.g, weighed.cross, to_relative)
    return Linearised(system, H, g_pose, weighed.cost + known.cost)


def robust_sum(r: Tensor, front: Tensor, robust: Robust) -> tuple[Tensor, Tensor]:
    """Robust cost ``()`` in double precision of whitened residuals ``(..., B, T, L)`` and the roots of their weights.

    Pairs behind the camera cost ``robust.far`` and have zero weight.
    """
    value, weight = rho(torch.where(front, r * r, robust.far), robust.kernel, robust.delta)
    # Short sums in the rows' precision, the long sum in double.
    return value.sum(-1).sum(dtype=torch.float64), torch.where(front, weight.sqrt(), 0.0)
