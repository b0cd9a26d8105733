"""Anchors of a window: reprojections and depth priors, their normal equations and their elimination.

An observation's residual depends on the anchor and on the pose through one point, the anchor in the camera. With the
pose's tangent taken in the world, about a centre ``c`` near the anchors, both derivatives are the same rows: with
``B = (d r / d p_c) R`` by the anchor and ``B [I, -hat(p_w - c)]`` by the pose. So an observation is summarised by
``B^T B`` and ``B^T r``, nine numbers; the anchor's block is their sum, the pose's block a sum of their products with
powers of the anchor's position, and their coupling is ``[I; hat(p_w - c)] B^T B``. The adjoint maps the pose system
to the cameras' tangents, in which the solver damps and steps.

Observations lie in tiles of one pose each, so that a pose's rotation is a factor of a batched product; empty slots
have zero weight.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from edgeslam_torch.losses.robust import Kernel, rho
from edgeslam_torch.optim.kernels import schur
from edgeslam_torch.optim.kernels.compiled import kernel
from edgeslam_torch.optim.problem import DepthPriors, LmConfig, WindowProblem
from edgeslam_torch.types import FloatArray, IntArray

_LANES = 128
"""Observations per tile: shorter tiles have fewer empty slots, longer ones give fewer, larger products."""
_FEW_POSES = 12
"""Up to this many free poses, cutting the anchors into chunks saves less than it costs."""
_ANCHORS_PER_CHUNK = 192
_NO_DEPTH_PRIORS = DepthPriors(np.zeros(0, int), np.zeros(0, int), np.zeros(0), np.zeros(0))


class Observed(NamedTuple):
    """Observations in ``G`` tiles of ``L``."""

    pose: Tensor
    """``(G,)`` pose of each tile."""
    place: Tensor
    """``(G, 3, L)`` indices of the anchors' coordinates in ``(3, A)``."""
    uv: Tensor
    """``(G, 2, L)`` pixels from the principal point, whitened."""
    focal: Tensor
    """``(G, 2, L)`` focal lengths, whitened."""
    far: Tensor
    """``(G, L)`` cost of a point behind the camera."""
    depth_row: Tensor
    """``(D,)`` indices of the depth priors in ``G L``; their ``focal`` is zero."""
    inverse_depth: Tensor
    """``(D,)`` expected inverse depths, whitened."""
    inv_sigma: Tensor
    """``(D,)`` their inverse standard deviations."""
    centre: Tensor
    """``(3,)`` of the anchors: these are kept from here."""
    min_depth: float
    """Nearest depth in front of a camera."""


class Places(NamedTuple):
    """Where the sums of the observations go. Tiles of free poses come first, ``G'`` of ``G``."""

    own: Tensor
    """``(9 G L)`` of an observation's nine sums in ``(9, A)``."""
    anchor: Tensor
    """``(G' L)`` the anchors that free poses see."""
    column: Tensor
    """``(G',)`` free-pose numbers of their tiles."""
    free_pose: Tensor
    """``(F,)`` the free poses."""
    factor: Tensor
    """``(G', 6, L)`` of the anchors' factors in ``(6, A)``."""
    entry: Tensor
    """``(3 G' L)`` rows of the anchors' whitened coordinates, by the observations' poses, in `Eliminated.Y`."""
    entries: int
    """Rows of `Eliminated.Y`; the last takes what places without an observation store."""
    unique: bool
    """Whether no pose sees an anchor twice: entries can then be stored without adding."""


class Normals(NamedTuple):
    """A `PointSystem`, and what the anchors add to the pose system."""

    system: "PointSystem"
    H: Tensor
    """``(F, 6, 6)`` the free poses' own blocks."""
    g: Tensor
    """``(F, 6)``."""
    cost: Tensor
    """``()``."""


class PointSystem(NamedTuple):
    """Normal equations of the anchors at one state."""

    V: Tensor
    """``(6, A)`` upper triangles of the anchors' blocks."""
    g: Tensor
    """``(3, A)`` their gradients."""
    own: Tensor
    """``(G', 9, L)`` what each observation of a free pose adds to its anchor's block and gradient, see `rotated`."""
    position: Tensor
    """``(G', 3, L)`` the anchors of those observations."""
    to_world: Tensor
    """``(F, 6, 6)`` tangents in the world by tangents in the camera."""


class Eliminated(NamedTuple):
    """Anchors eliminated from the pose system, for back-substitution."""

    factor: Tensor
    """``(6, A)`` inverse Cholesky factors."""
    y: Tensor
    """``(3, A)`` whitened gradients."""
    Y: Tensor
    """Coupling of poses and whitened anchors, all chunks, see `Chunk`."""


@dataclass(frozen=True, slots=True)
class Chunk:
    """Consecutive anchors with the ``w`` free poses that see them."""

    first: int
    last: int
    """Anchors ``first <= a < last``."""
    begin: int
    end: int
    """Rows of ``Y (..., 6)``: the anchors' three whitened coordinates, anchor by anchor, each by the ``w`` poses;
    read as ``(3 (last - first), 6 w)``."""
    poses: Tensor
    """``(w,)`` free-pose numbers."""


class PointBlocks:
    """Layout of a window's anchors and observations."""

    def __init__(self, problem: WindowProblem, K: Tensor, column: IntArray, config: LmConfig) -> None:
        """Lay out.

        Args:
            problem: A window.
            K: fx, fy, cx, cy.
            column: ``(W,)`` free-pose number of each pose, -1 for a fixed one.
            config: Kernel, its width and what counts as behind a camera.
        """
        self.config = config
        self.dtype = torch.float32 if config.float32_blocks else torch.float64
        depth = problem.depth_priors or _NO_DEPTH_PRIORS
        self.n_obs, A = len(problem.obs_pose), len(problem.p_w)
        self.free = F = int((column >= 0).sum())
        pose = np.concatenate((_index(problem.obs_pose), _index(depth.pose)))
        anchor = np.concatenate((_index(problem.obs_anchor), _index(depth.anchor)))
        rank_of_pose = np.where(column < 0, F, column)
        self.anchor_order = _by_poses(rank_of_pose[pose], anchor, A, F) if F > _FEW_POSES else None
        if self.anchor_order is not None:
            rank = np.empty(A, dtype=np.int64)
            rank[self.anchor_order] = np.arange(A)
            anchor = rank[anchor]
        # Tiles by pose, those of free poses first.
        pose_rank = np.empty(len(column), dtype=np.int16 if len(column) < 2**15 else np.int64)
        by_column = np.argsort(rank_of_pose, kind="stable")
        pose_rank[by_column] = np.arange(len(column))
        run = pose_rank[pose]
        order = np.argsort(run, kind="stable")
        count = np.bincount(run, minlength=len(column))
        tiles = -(-count // _LANES)
        free_tiles = int(tiles[:F].sum())
        G = int(tiles.sum())
        gap = (np.cumsum(tiles) - tiles) * _LANES - (np.cumsum(count) - count)
        self.place = np.empty(len(order), dtype=np.int64)  # of each factor, in the caller's order
        self.place[order] = np.arange(len(order)) + np.repeat(gap, count)
        tile_run = np.repeat(np.arange(len(column)), tiles)
        # Empty slots have zero weight and point to the first anchor.
        lane_anchor = np.zeros(G * _LANES, dtype=np.int64)
        lane_anchor[self.place] = anchor
        uv, focal = np.zeros((2, G * _LANES)), np.zeros((2, G * _LANES))
        inv_sigma = np.concatenate((np.asarray(problem.inv_sigma, float), 1.0 / np.asarray(depth.sigma, float)))
        seen = self.place[: self.n_obs]
        k = K.cpu().numpy()
        pixels = np.asarray(problem.uv, dtype=np.float64).reshape(-1, 2)
        for i in range(2):
            uv[i, seen] = (pixels[:, i] - k[2 + i]) * inv_sigma[: self.n_obs]
            focal[i, seen] = k[i] * inv_sigma[: self.n_obs]
        far = np.zeros(G * _LANES)
        far[self.place] = np.square(config.behind_px * inv_sigma)
        p_w = np.asarray(problem.p_w, dtype=np.float64).reshape(-1, 3)
        centre = np.median(p_w, axis=0) if A else np.zeros(3)  # some anchors may be practically at infinity
        p = (p_w if self.anchor_order is None else p_w[self.anchor_order]) - centre
        self.p = torch.as_tensor(np.ascontiguousarray(p.T))
        anchors: IntArray = lane_anchor.reshape(G, _LANES)
        self.seen = Observed(
            pose=torch.as_tensor(by_column[tile_run]),
            place=torch.as_tensor(anchors[:, None] + A * np.arange(3)[:, None]),
            uv=_tiled(uv),
            focal=_tiled(focal),
            far=torch.as_tensor(far).view(G, _LANES),
            depth_row=torch.as_tensor(self.place[self.n_obs :]),
            inverse_depth=torch.as_tensor(np.asarray(depth.inverse_depth, dtype=np.float64) * inv_sigma[self.n_obs :]),
            inv_sigma=torch.as_tensor(inv_sigma[self.n_obs :]),
            centre=torch.as_tensor(centre),
            min_depth=config.min_depth,
        )
        free_anchor, tile_column = anchors[:free_tiles], tile_run[:free_tiles]
        used = np.zeros(G * _LANES, dtype=bool)
        used[self.place] = True
        entry, entries, unique = self._plan(free_anchor, tile_column, used.reshape(G, _LANES)[:free_tiles], A)
        self.places = Places(
            own=torch.as_tensor((anchors[:, None] + A * np.arange(9)[:, None]).reshape(-1)),
            anchor=torch.as_tensor(free_anchor.reshape(-1)),
            column=torch.as_tensor(tile_column),
            free_pose=torch.as_tensor(by_column[:F]),
            factor=torch.as_tensor(free_anchor[:, None] + A * np.arange(6)[:, None]),
            entry=torch.as_tensor(entry),
            entries=entries,
            unique=unique,
        )

    def _plan(self, anchor: IntArray, column: IntArray, used: np.ndarray, A: int) -> tuple[IntArray, int, bool]:
        """Lay out the ``Y``: one over few poses, else a band of them; see `Places` for what is returned."""
        F = self.free
        size = max(A, 1) if self.anchor_order is None else _ANCHORS_PER_CHUNK
        starts = np.arange(0, A, size)
        length = np.minimum(starts + size, A) - starts
        seen = np.ones((len(starts), F), dtype=bool)
        column = np.broadcast_to(column[:, None], anchor.shape)
        chunk = anchor // size
        if self.anchor_order is not None:
            seen[:] = False
            seen[chunk[used], column[used]] = True
            column = (np.cumsum(seen, axis=1) - 1)[chunk, column]
        width = seen.sum(1)
        ends = np.cumsum(3 * width * length)
        rows = int(ends[-1]) if len(ends) else 0
        begin = ends - 3 * width * length
        place = begin[chunk] + width[chunk] * (anchor - size * chunk) + column
        unique = int(np.bincount(place[used], minlength=1).max()) <= 1
        # Places of a tile without an observation store their zeros behind all others.
        place = np.where(used, place, rows) + np.where(used, (width * length)[chunk], 0) * np.arange(3)[:, None, None]
        self.chunks = [
            Chunk(
                first=int(starts[c]),
                last=int(starts[c] + length[c]),
                begin=int(begin[c]),
                end=int(ends[c]),
                poses=torch.as_tensor(np.flatnonzero(seen[c])),
            )
            for c in range(len(starts))
            if seen[c].any()
        ]
        return place.reshape(-1), rows + 1, unique

    def cost(self, T_c_w: Tensor, p: Tensor) -> Tensor:
        """Robust cost ``()`` at poses ``(W, 4, 4)`` and anchors ``(3, A)``."""
        out: Tensor = kernel(point_cost, self.config.compile)(T_c_w, p, self.seen, *self._kernel())
        return out

    def chi2(self, T_c_w: Tensor, p: Tensor) -> tuple[FloatArray, np.ndarray]:
        """Squared whitened residuals ``(M,)`` of the observations and which lie in front, in the caller's order."""
        s, front, *_ = evaluate(T_c_w, p, self.seen)
        at = self.place[: self.n_obs]
        in_front: np.ndarray = front.cpu().numpy().reshape(-1)[at]
        return np.where(in_front, s.cpu().numpy().reshape(-1)[at], np.inf), in_front

    def in_callers_order(self, p: Tensor) -> FloatArray:
        """Anchors ``(3, A)`` as ``(A, 3)`` in the world."""
        ours = (p + self.seen.centre[:, None]).mT.cpu().numpy()
        if self.anchor_order is None:
            return np.ascontiguousarray(ours)
        out: FloatArray = np.empty_like(ours)
        out[self.anchor_order] = ours
        return out

    def linearise(self, T_c_w: Tensor, p: Tensor) -> Normals:
        """Normal equations at poses ``(W, 4, 4)`` and anchors ``(3, A)``."""
        linear = kernel(point_normals, self.config.compile)
        out: Normals = linear(T_c_w, p, self.seen, self.places, *self._kernel())
        return out

    def reduce(self, system: PointSystem, mu: float, S: Tensor, b: Tensor) -> Eliminated:
        """Eliminate the anchors from the pose system ``S (6F, 6F)`` and its right side ``b (6F,)``."""
        exact = mu == 0.0  # not to step, but to say what is observed
        damping = torch.tensor(mu, dtype=torch.float64)
        whitened = kernel(coupled, self.config.compile)
        eliminated: Eliminated = whitened(system, self.places, damping, torch.float64 if exact else self.dtype)
        y, Y = eliminated.y, eliminated.Y
        F = self.free
        # Sums of 6x6 blocks and of vectors; in the precision of the products, which are long sums themselves.
        taken, right = torch.zeros(F * F, 36, dtype=Y.dtype), torch.zeros(F, 6, dtype=Y.dtype)
        for chunk, part in self._parts(Y):
            w = len(chunk.poses)
            product = (part.mT @ part).view(w, 6, w, 6).transpose(1, 2).reshape(-1, 36)
            moved = y[:, chunk.first : chunk.last].reshape(-1).to(Y.dtype) @ part
            taken.index_add_(0, (F * chunk.poses[:, None] + chunk.poses).view(-1), product)
            right.index_add_(0, chunk.poses, moved.view(w, 6))
        to_camera = system.to_world.mT
        half = to_camera @ taken.view(F, F, 6, 6).transpose(1, 2).double().reshape(F, 6, 6 * F)
        S -= (to_camera @ half.view(6 * F, 6 * F).mT.reshape(F, 6, 6 * F)).view(6 * F, 6 * F)  # it is symmetric
        b -= (to_camera @ right.double()[..., None]).view(-1)
        return eliminated

    def step(self, system: PointSystem, eliminated: Eliminated, delta: Tensor) -> Tensor:
        """Back-substitution: step of the anchors ``(3, A)`` for the poses' ``delta (6F,)``."""
        in_world = (system.to_world @ delta.view(-1, 6, 1))[..., 0].to(eliminated.Y.dtype)
        back = -eliminated.y
        for chunk, part in self._parts(eliminated.Y):
            back[:, chunk.first : chunk.last] -= (part @ in_world[chunk.poses].view(-1)).view(3, -1)
        return schur.unwhiten(eliminated.factor, back)

    def _parts(self, Y: Tensor) -> list[tuple[Chunk, Tensor]]:
        """The chunks with their pieces of ``Y``, ``(3 (last - first), 6 w)``."""
        return [(c, Y[c.begin : c.end].view(-1, 6 * len(c.poses))) for c in self.chunks]

    def _kernel(self) -> tuple[Kernel, float]:
        return self.config.kernel, self.config.delta


def evaluate(T_c_w: Tensor, p: Tensor, seen: Observed) -> tuple[Tensor, ...]:
    """Squared whitened residuals of all slots.

    Args:
        T_c_w: World-to-camera poses ``(W, 4, 4)``.
        p: Anchors from their centre ``(3, A)``.
        seen: The observations.

    Returns:
        Squares ``(G, L)``, which lie in front, which have weight, inverse depths ``(G, L)``, normalised coordinates
        ``(G, 2, L)``, residuals ``(G, 2, L)`` (zero for depth priors), the depth priors' ``(D,)``, and the anchors
        ``(G, 3, L)``. Squares are limited to the cost of a point behind the camera: points that far outside the image
        have zero weight (their squared slopes would overflow double precision).
    """
    R, t = T_c_w[:, :3, :3], T_c_w[:, :3, 3:]
    position = p.reshape(-1).index_select(0, seen.place.reshape(-1)).view(seen.place.shape)
    p_c = torch.baddbmm((R @ seen.centre[:, None] + t)[seen.pose], R[seen.pose], position)
    front = p_c[:, 2] > seen.min_depth
    iz = torch.where(front, p_c[:, 2], 1.0).reciprocal()
    n = p_c[:, :2] * iz[:, None]
    r = n * seen.focal - seen.uv
    s = torch.addcmul(r[:, 0] * r[:, 0], r[:, 1], r[:, 1])
    r_depth = seen.inverse_depth
    if len(seen.depth_row):
        r_depth = iz.view(-1)[seen.depth_row] * seen.inv_sigma - seen.inverse_depth
        s = s.view(-1).index_add(0, seen.depth_row, r_depth.square()).view(s.shape)
    used = front & (s < seen.far)
    return torch.where(used, s, seen.far), front, used, iz, n, r, r_depth, position


def point_cost(T_c_w: Tensor, p: Tensor, seen: Observed, robust: Kernel, delta: float) -> Tensor:
    """Robust cost ``()``; arguments as `evaluate` takes them, then the kernel and its width."""
    return rho(evaluate(T_c_w, p, seen)[0], robust, delta)[0].sum()


def point_normals(T_c_w: Tensor, p: Tensor, seen: Observed, places: Places, robust: Kernel, delta: float) -> Normals:
    """Normal equations; arguments as `point_cost` takes them, and where the sums go."""
    s, _, used, iz, n, r, r_depth, position = evaluate(T_c_w, p, seen)
    value, weight = rho(s, robust, delta)
    weight = torch.where(used, weight, 0.0)
    slope = seen.focal * iz[:, None]
    weighted = slope * weight[:, None]
    ab, q = weighted * slope, weighted * r
    abn = ab * n
    mzz = torch.addcmul(abn[:, 0] * n[:, 0], abn[:, 1], n[:, 1])
    qz = torch.addcmul(q[:, 0] * n[:, 0], q[:, 1], n[:, 1])
    if len(seen.depth_row):
        row = seen.depth_row
        slope_depth = iz.view(-1)[row].square() * seen.inv_sigma
        weighted_depth = weight.view(-1)[row] * slope_depth
        mzz = mzz.view(-1).index_add(0, row, weighted_depth * slope_depth).view(mzz.shape)
        qz = qz.view(-1).index_add(0, row, weighted_depth * r_depth).view(qz.shape)
    own = rotated(T_c_w)[seen.pose] @ torch.cat((ab, abn, mzz[:, None], q, qz[:, None]), 1)
    A, F, G = p.shape[1], len(places.free_pose), len(places.column)
    sums = torch.zeros(9 * A, dtype=p.dtype, device=p.device).scatter_add_(0, places.own, own.view(-1)).view(9, A)
    # A pose's block: sums of products with 1, x, y, z, xx, xy, xz, yy, yz, zz.
    x, y, z = p[:1], p[1:2], p[2:]
    powers = torch.cat((torch.ones_like(x), p, x * p, y * p[1:], z * z)).mT.contiguous()
    products = own[:G] @ powers.index_select(0, places.anchor).view(*own[:G, 0].shape, 10)
    moments = torch.zeros(F, 90, dtype=p.dtype, device=p.device).index_add_(0, places.column, products.view(G, 90))
    in_world = (moments @ _MOMENTS.to(p.device)).view(F, 6, 7)
    to_world = tangents_in_world(T_c_w.index_select(0, places.free_pose), seen.centre)
    in_camera = to_world.mT @ in_world
    H = in_camera[..., :6] @ to_world
    V, g = sums.index_select(0, _UPPER.to(p.device)), sums.index_select(0, _GRADIENT.to(p.device))
    return Normals(PointSystem(V, g, own[:G], position[:G], to_world), H, in_camera[..., 6], value.sum())


def tangents_in_world(T_c_w: Tensor, centre: Tensor) -> Tensor:
    """``(F, 6, 6)`` with ``exp(xi) T C = T C exp(M xi)``, ``C`` being the shift by the centre ``(3,)``."""
    R_t = T_c_w[:, :3, :3].mT
    t = T_c_w[:, :3, 3] + centre @ R_t
    turn = R_t @ (t @ _MINUS_HAT.to(t.device)).view(-1, 3, 3)
    return torch.cat((torch.cat((R_t, turn), 2), torch.cat((torch.zeros_like(turn), R_t), 2)), 1)


def rotated(T_c_w: Tensor) -> Tensor:
    """Matrices that map sums in camera coordinates to world coordinates, ``(W, 9, 8)`` for poses ``(W, 4, 4)``.

    In: ``J^T J`` of an observation by the point in its camera, as xx, yy, -xz, -yz, zz (xy is zero), then its
    ``J^T r`` as x, y, -z. Out: ``R^T J^T J R`` and ``R^T J^T r`` as xx, xy, xz, yy, x, yz, y, z, zz, an order in which
    each row of the matrix is a slice: 0 to 2 by one, 1 to 5 by two, 2 to 8 by three.
    """
    x, y, z = T_c_w[:, :3, :3].unbind(1)  # the camera's axes in the world

    def product(a: Tensor, b: Tensor) -> Tensor:
        return a[:, _ROW] * b[:, _COLUMN]

    squares = (
        product(x, x),
        product(y, y),
        -product(x, z) - product(z, x),
        -product(y, z) - product(z, y),
        product(z, z),
    )
    out = torch.zeros(len(x), 9, 8, dtype=x.dtype, device=x.device)
    out[:, _UPPER.to(x.device), :5] = torch.stack(squares, 2)
    out[:, _GRADIENT.to(x.device), 5:] = torch.stack((x, y, -z), 2)
    return out


def coupled(system: PointSystem, places: Places, damping: Tensor, dtype: torch.dtype) -> Eliminated:
    """Whitened anchors and their coupling with the free poses.

    Args:
        system: Normal equations.
        places: Where the couplings go.
        damping: Relative to the diagonal ``()``.
        dtype: Of the coupling: it comes after the cancellation and is only multiplied with itself.
    """
    factor = schur.inverse_cholesky(system.V, damping)
    f = factor.view(-1).index_select(0, places.factor.reshape(-1)).view(places.factor.shape)[:, :, None]
    a, b, c, d, e, f = f.unbind(1)
    first, second, third = system.own[:, 0:3], system.own[:, 1:6:2], system.own[:, 2:9:3]
    whitened = torch.stack(
        (a * first, torch.addcmul(b * first, c, second), torch.addcmul(torch.addcmul(d * first, e, second), f, third))
    ).to(dtype)
    x, y, z = system.position.to(dtype).unbind(1)
    u, v, w = whitened.unbind(2)
    turning = torch.stack(
        (
            torch.addcmul(y * w, z, v, value=-1.0),
            torch.addcmul(z * u, x, w, value=-1.0),
            torch.addcmul(x * v, y, u, value=-1.0),
        ),
        2,
    )
    entries = torch.cat((whitened, turning), 2).mT.reshape(-1, 6)
    Y = torch.zeros(places.entries, 6, dtype=dtype, device=entries.device)
    if places.unique:
        Y.index_copy_(0, places.entry, entries)
    else:
        Y.index_add_(0, places.entry, entries)
    return Eliminated(factor, schur.whiten(factor, system.g), Y)


_MATRIX = np.array([[0, 1, 2], [1, 3, 5], [2, 5, 8]])
"""Indices of ``R^T J^T J R`` in the output of `rotated`."""
_VECTOR = np.array([4, 6, 7])
"""Indices of ``R^T J^T r`` in it."""
_ROW, _COLUMN = (i.tolist() for i in np.triu_indices(3))  # numpy arrays cannot be compiled under inference mode
_UPPER = torch.as_tensor(_MATRIX[_ROW, _COLUMN])
_GRADIENT = torch.as_tensor(_VECTOR)
_POWER = np.array([[0, 1, 2, 3], [1, 4, 5, 6], [2, 5, 7, 8], [3, 6, 8, 9]])
"""Where the product of two of 1, x, y, z is in 1, x, y, z, xx, xy, xz, yy, yz, zz."""


def _moment_map() -> Tensor:
    """``(90, 42)``: from products of an observation's nine sums with the ten powers of its anchor's position to H | g.

    With ``D = [I, -hat(p)]``, linear in 1, x, y, z, the pose's block is the sum of ``D^T M D`` and its gradient that of
    ``D^T v``: entry by entry, sums and powers that are multiplied.
    """
    D = np.zeros((3, 6, 4))
    D[range(3), range(3), 0] = 1.0
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        D[i, 3 + j, 1 + k], D[j, 3 + i, 1 + k] = 1.0, -1.0
    matrix, vector, power = np.eye(9)[_MATRIX], np.eye(9)[_VECTOR], np.eye(10)[_POWER]
    H = np.einsum("ics,jdt,ijm,stp->mpcd", D, D, matrix, power)
    g = np.einsum("ics,im,sp->mpc", D, vector, power[0])
    return torch.as_tensor(np.concatenate((H, g[..., None]), 3).reshape(90, 42))


_MOMENTS = _moment_map()
_MINUS_HAT = torch.zeros(3, 9, dtype=torch.float64)  # of a vector, row by row
_MINUS_HAT[[2, 1, 2, 0, 1, 0], [1, 2, 3, 5, 6, 7]] = torch.tensor([1, -1, -1, 1, 1, -1], dtype=torch.float64)


def _by_poses(column: IntArray, anchor: IntArray, A: int, F: int) -> IntArray:
    """Anchors by the first and last free pose that sees them: chunks then span few poses."""
    first, last = np.full(A, F), np.full(A, -1)
    np.minimum.at(first, anchor, column)
    np.maximum.at(last, anchor, np.where(column < F, column, -1))
    return np.argsort(first * (F + 1) + last, kind="stable")


def _tiled(rows: FloatArray) -> Tensor:
    """``(n, G L)`` as ``(G, n, L)``."""
    return torch.as_tensor(np.ascontiguousarray(rows.reshape(len(rows), -1, _LANES).transpose(1, 0, 2)))


def _index(x: IntArray) -> IntArray:
    return np.asarray(x, dtype=np.int64)
