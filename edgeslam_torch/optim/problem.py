"""Input and output records of a refinement, in numpy."""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edgeslam_torch.types import FloatArray, IntArray


class StopReason(StrEnum):
    """Why the solver stopped."""

    COST_CONVERGED = "cost converged"
    STEP_CONVERGED = "step converged"
    GRADIENT_CONVERGED = "gradient converged"
    MAX_ITERATIONS = "iteration limit"
    STALLED = "no step lowers the cost"
    SINGULAR = "reduced system not positive definite"
    NO_OBSERVATIONS = "no usable observations"
    NOT_FINITE = "not finite"

    @property
    def converged(self) -> bool:
        """Whether the state is a minimum within the tolerances."""
        return self in (self.COST_CONVERGED, self.STEP_CONVERGED, self.GRADIENT_CONVERGED)


@dataclass(frozen=True, slots=True)
class PosePrior:
    """Prior on one pose: ``log(T_c_w T_prior^-1) ~ N(0, information^-1)``."""

    pose: int
    T_c_w: FloatArray
    """``(4, 4)`` expected world-to-camera pose."""
    information: FloatArray
    """``(6, 6)`` inverse covariance, translation first, of a left perturbation."""


@dataclass(frozen=True, slots=True)
class RelativePosePrior:
    """Prior on a relative pose: ``log(T_j T_i^-1 T_j_i^-1) ~ N(0, information^-1)``."""

    pose_i: int
    pose_j: int
    T_j_i: FloatArray
    """``(4, 4)`` expected pose, takes coordinates of i to j."""
    information: FloatArray
    """``(6, 6)`` inverse covariance, translation first, of a left perturbation."""


@dataclass(frozen=True, slots=True)
class ScalePrior:
    """Expected distance between two camera centres; fixes the scale gauge."""

    pose_i: int
    pose_j: int
    distance: float
    sigma_log: float
    """Standard deviation of the log of the distance."""


@dataclass(frozen=True, slots=True)
class DepthPriors:
    """Expected inverse z-depths of anchors in host poses, as from a depth network."""

    anchor: IntArray
    """``(D,)`` anchor indices."""
    pose: IntArray
    """``(D,)`` host pose indices."""
    inverse_depth: FloatArray
    """``(D,)`` [1/m]."""
    sigma: FloatArray
    """``(D,)`` standard deviations [1/m]."""


@dataclass(frozen=True, slots=True)
class EdgeTerms:
    """Edge pixels with inverse depths, and their partners in other poses of the window.

    ``E`` edges, ``P`` pairs (edge, target pose). Their depths are refined too.
    """

    host: IntArray
    """``(E,)`` pose that owns the pixel."""
    uv: FloatArray
    """``(E, 2)`` undistorted pixels."""
    inverse_depth: FloatArray
    """``(E,)`` start [1/m]."""
    prior: FloatArray
    """``(E,)`` expected inverse depth, from the network [1/m]."""
    prior_sigma: FloatArray
    """``(E,)`` its standard deviation; infinite for none."""
    pair_edge: IntArray
    """``(P,)`` edge indices."""
    pair_pose: IntArray
    """``(P,)`` target poses, never the host."""
    pair_uv: FloatArray
    """``(P, 2)`` nearest edge pixel in the target."""
    pair_normal: FloatArray
    """``(P, 2)`` its unit normal."""
    pair_inv_sigma: FloatArray
    """``(P,)`` inverse standard deviation across the edge [1/px]; zero switches alignment off."""
    pair_inverse_depth: FloatArray
    """``(P,)`` inverse depth of the target there, held constant; zero if unknown (no cycle)."""
    cycle_px: bool = False
    """The cycle in pixels, as in the paper, instead of relative depth."""
    cycle_sigma: float = 0.0
    """Standard deviation of the cycle in its own unit; zero switches it off."""


@dataclass(frozen=True, slots=True)
class JunctionTerms:
    """L-junctions: a corner and the ends of two straight arms, with three inverse depths each.

    ``C`` junctions, ``Q`` pairs (junction, target pose).
    """

    host: IntArray
    """``(C,)`` pose that owns it."""
    uv: FloatArray
    """``(C, 3, 2)`` corner, end of arm 1, end of arm 2 [px]."""
    inverse_depth: FloatArray
    """``(C, 3)`` start [1/m]."""
    prior: FloatArray
    """``(C, 3)`` expected inverse depths: along a straight arm inverse depth is linear in the image, so the
    collinearity of its edge points (paper eq. 26) is the fit of a line to theirs, see `mapping.window_terms`."""
    prior_information: FloatArray
    """``(C, 3, 3)`` inverse covariance of ``prior``."""
    pair_junction: IntArray
    """``(Q,)`` junction indices."""
    pair_pose: IntArray
    """``(Q,)`` target poses, never the host."""
    pair_uv: FloatArray
    """``(Q, 2)`` corner observed there [px]."""
    pair_arms: FloatArray
    """``(Q, 2, 2)`` unit directions of the arms observed there."""
    inv_sigma_px: float = 1.0
    """Inverse standard deviation of a corner's position [1/px]; zero switches it off."""
    inv_sigma_angle: float = 20.0
    """Inverse standard deviation of an angle row; zero switches it off."""
    cosines: bool = False
    """One cosine per junction (the paper's angle) instead of both arms' directions."""


@dataclass(frozen=True, slots=True)
class CentreFactor:
    """A Gaussian of some camera centres."""

    pose: IntArray
    """``(K,)`` pose indices."""
    information: FloatArray
    """``(3 K, 3 K)`` symmetric, positive semidefinite."""
    vector: FloatArray
    """``(3 K,)`` information times mean."""
    constant: float = 0.0
    """Constant that makes the cost a chi-square."""


@dataclass(frozen=True, slots=True)
class GravityFactor:
    """The world's up direction measured in cameras."""

    pose: IntArray
    """``(U,)`` pose indices."""
    up_c: FloatArray
    """``(U, 3)`` measured unit vectors, camera axes."""
    up_w: FloatArray
    """``(3,)`` the same in the world."""
    sigma_rad: float
    """Standard deviation of each, per axis."""


@dataclass(frozen=True, slots=True)
class HeadingFactor:
    """A Gaussian of some cameras' rotations about the world's vertical."""

    pose: IntArray
    """``(U,)`` pose indices."""
    R_c_w: FloatArray
    """``(U, 3, 3)`` measured world-to-camera rotations."""
    up_w: FloatArray
    """``(3,)`` unit vector of the vertical in the world."""
    information: FloatArray
    """``(U, U)`` symmetric, positive semidefinite [1/rad^2]."""


@dataclass(frozen=True, slots=True)
class WindowProblem:
    """Poses and anchors to refine together; ``W`` poses, ``A`` anchors, ``M`` observations."""

    T_c_w: FloatArray
    """``(W, 4, 4)`` world-to-camera poses."""
    pose_fixed: NDArray[np.bool_]
    """``(W,)`` poses that fix the gauge."""
    p_w: FloatArray
    """``(A, 3)`` anchors in the world."""
    obs_pose: IntArray
    """``(M,)`` observing pose."""
    obs_anchor: IntArray
    """``(M,)`` observed anchor."""
    uv: FloatArray
    """``(M, 2)`` undistorted pixels."""
    inv_sigma: FloatArray
    """``(M,)`` inverse standard deviation of a keypoint [1/px], from its octave."""
    K: tuple[float, float, float, float]
    """fx, fy, cx, cy [px]."""
    relative_priors: tuple[RelativePosePrior, ...] = ()
    scale_priors: tuple[ScalePrior, ...] = ()
    depth_priors: DepthPriors | None = None
    edges: EdgeTerms | None = None
    junctions: JunctionTerms | None = None
    centres: tuple[CentreFactor, ...] = ()
    gravity: tuple[GravityFactor, ...] = ()
    headings: tuple[HeadingFactor, ...] = ()


@dataclass(frozen=True, slots=True)
class LmConfig:
    """Settings of the solver."""

    max_iterations: int = 10
    """Maximum number of steps, accepted or not."""
    robust: bool = True
    """Huber's kernel; otherwise plain squares, the paper's form."""
    mu: float = 1e-4
    """Initial damping, relative to the diagonal of the normal matrix."""
    cost_tolerance: float = 1e-5
    """Relative decrease of the cost below which an accepted step is the last."""
    pose_tolerance: float = 0.0
    """Expected distance of the poses to the minimum [standard deviations, all poses together] that ends the search."""
    behind_px: float = 1000.0
    """Residual of an observation behind the camera, and upper limit of all residuals."""
    solver: str = "compiled"
    """Implementation of residuals and derivatives: the ``compiled`` loops of `optim.kernels`, or the ``modules`` of
    `losses` with automatic differentiation."""
    losses: bool = False
    """Report the losses of the result."""
    diagnostics: bool = True
    """Report rank deficiency and the newest pose's covariance (costs one more linearisation)."""

    def __post_init__(self) -> None:
        if self.max_iterations < 0:
            raise ValueError(f"max_iterations must not be negative, got {self.max_iterations}")
        if self.solver not in ("compiled", "modules"):
            raise ValueError(f"solver must be compiled or modules, got {self.solver!r}")
        if self.mu <= 0:
            raise ValueError(f"mu must be positive, got {self.mu}")


@dataclass(frozen=True, slots=True)
class WindowResult:
    """Refined state and diagnostics."""

    T_c_w: FloatArray
    """``(W, 4, 4)`` refined world-to-camera poses."""
    p_w: FloatArray
    """``(A, 3)`` refined anchors."""
    chi2: FloatArray
    """``(M,)`` squared whitened reprojection residuals at the result; infinite behind the camera."""
    cost_before: float
    """Robust cost (sum of rho) at the start."""
    cost_after: float
    iterations: int
    """Steps tried."""
    stop: StopReason
    edge_inverse_depth: FloatArray = field(default_factory=lambda: np.zeros(0))
    """``(E,)`` refined inverse depths of the edges."""
    junction_inverse_depth: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    """``(C, 3)`` refined inverse depths of the junctions."""
    rank_deficiency: int = 0
    """Unobservable directions of the free poses (1 for a free scale), -1 when not computed."""
    losses: dict[str, float] = field(default_factory=dict)
    """The losses of the result by name, see `window_losses`; empty unless `LmConfig.losses` is set."""
    pose_covariance: FloatArray = field(default_factory=lambda: np.full((6, 6), np.nan))
    """``(6, 6)`` of the last free pose, left tangent, anchors marginalised; NaN when not computed."""


class Rows(Protocol):
    """Whitened residuals of every kind ``(n, k)``, their derivatives by poses and blocks ``(n, k, 6 + m)``, and which
    lie in front of the camera ``(n,)``; arguments as those of `optim.kernels`."""

    reprojection: Callable[..., Any]
    inverse_depth: Callable[..., Any]
    edges: Callable[..., Any]
    junctions: Callable[..., Any]
