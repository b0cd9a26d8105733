"""Settings of the SLAM system with unit, default and reason. Read from TOML into frozen dataclasses.

One section per stage, collected in `SlamConfig`. Functions take plain arguments or one section, never the whole.
"""

import math
from dataclasses import dataclass, field, fields, is_dataclass, replace
from typing import Any

from edgeslam_torch.estimation.config import FusionConfig


def _check_numbers(config: Any, prefix: str = "") -> None:
    """Require finite numbers, and integers that OpenCV and torch accept."""
    for field_ in fields(config):
        value, name = getattr(config, field_.name), prefix + field_.name
        if is_dataclass(value):
            _check_numbers(value, f"{name}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and not math.isfinite(number):
                raise ValueError(f"{name} must be finite, got {number}")
            if isinstance(number, int) and not -(2**31) <= number < 2**31:
                raise ValueError(f"{name} must be within 32 bits, got {number}")


def _positive(section: object, *names: str) -> None:
    for name in names:
        value = getattr(section, name)
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}")


def _at_most(section: object, **limits: float) -> None:
    """Check upper bounds; larger values only cost memory or time."""
    for name, limit in limits.items():
        value = getattr(section, name)
        if value > limit:
            raise ValueError(f"{name} must be at most {limit}, got {value}")


@dataclass(frozen=True, slots=True)
class OrbConfig:
    """Stage 1: keypoints."""

    features: int = 1000
    """Keypoints kept per frame; as in ORB-SLAM2 for 640x480."""
    scale_factor: float = 1.2
    """Ratio of the sizes of two pyramid levels; as in ORB-SLAM2."""
    levels: int = 8
    """Pyramid levels; as in ORB-SLAM2."""
    fast_threshold: int = 12
    """FAST threshold in grey levels; low, because the strongest corners of every cell are kept."""
    fast_faint: int = 4
    """FAST threshold where the image has few corners (cloth, white walls); about twice a camera's noise."""

    def __post_init__(self) -> None:
        _positive(self, "features", "levels", "fast_threshold", "fast_faint")
        _at_most(self, features=100_000, levels=20)
        if not 1.0 < self.scale_factor <= 2.0:
            raise ValueError(f"scale_factor must be in (1, 2], got {self.scale_factor}")


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """Stage 1: the depth network, once per keyframe."""

    weights: str = "default"
    """``default``, ``near``, ``none``, a weights file, a described ONNX file, or the name of a downloaded network."""
    backend: str = "onnxruntime"
    """``onnxruntime`` or ``torch``."""
    device: str = "cpu"
    """Device: ``auto``, ``cpu``, ``cuda`` or ``mps``. Rounding differs between devices; runs are reproducible on the
    same device only."""

    def __post_init__(self) -> None:
        if self.backend not in ("onnxruntime", "torch"):
            raise ValueError(f"backend must be onnxruntime or torch, got {self.backend!r}")
        if self.device not in ("auto", "cpu", "cuda", "mps"):
            raise ValueError(f"device must be auto, cpu, cuda or mps, got {self.device!r}")


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Stage 2: the pose of every frame."""

    min_inliers: int = 25
    """Minimum number of inliers of a pose."""
    edges: bool = True
    """Use edges for the pose of frames with few keypoints."""

    def __post_init__(self) -> None:
        _positive(self, "min_inliers")


@dataclass(frozen=True, slots=True)
class FlowConfig:
    """Stage 2, between keyframes: optical flow instead of matching."""

    enabled: bool = True
    """If off, keypoints are detected and matched in every frame."""
    points: int = 350
    """Maximum number of keypoints tracked from the last keyframe; with a pixel of noise at 525 px, 350 fix directions
    to 0.006 degrees."""

    def __post_init__(self) -> None:
        _positive(self, "points")


@dataclass(frozen=True, slots=True)
class InitialisationConfig:
    """Two-view initialisation, which replaces the map of the first frame's predicted depths."""

    min_parallax_deg: float = 0.75
    """Median angle that no rotation of the camera explains before two views are tried, and minimum parallax of each
    triangulated anchor."""
    keyframe_gap_s: float = 0.15
    """Minimum time between the intermediate frames that become keyframes after initialisation."""
    max_keyframes: int = 12
    """Maximum number of these frames; each requires an inference of the depth network."""
    max_direction_sigma: float = 0.15
    """Standard deviation of the newest camera's position relative to the baseline, under the network's depth as prior,
    above which initialisation waits: 0.15 are 8.6 degrees of direction. Refinement of the young map corrects more."""

    def __post_init__(self) -> None:
        _positive(self, "min_parallax_deg", "keyframe_gap_s", "max_keyframes", "max_direction_sigma")


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Stage 3: keyframes and anchors."""

    keyframe_min_gap_s: float = 0.14
    """Minimum time between keyframes: a camera moved by hand or in slow flight has then gained about a degree of
    parallax. Between the frames of videos at 10, 20 and 30 Hz, so that no rounding of stamps decides."""
    keyframe_max_gap_s: float = 0.98
    """Maximum time between keyframes while the camera moves: a second, less half a frame at 30 Hz for rounding."""
    keyframe_parallax_deg: float = 3.0
    """Insert a keyframe when the median parallax to the reference exceeds this: a pixel at 525 px focal length is
    then 4 % of the depth."""
    max_keyframes: int = 200
    """Number of keyframes in the map from which on the most redundant are removed. The only views of places are kept,
    up to twice this number. Limits memory and time."""
    neighbours: int = 6
    """Neighbouring keyframes used to triangulate new anchors."""
    window: int = 10
    """Keyframes refined together (the paper says "short")."""
    window_fixed: int = 15
    """Fixed keyframes outside the window, which fix its gauge."""
    sub_pixel: bool = True
    """Align keypoints of keyframes with the first views of their anchors. If off, corners are at whole pixels of their
    octave (as in the paper)."""
    loop_closure: bool = True
    """Detect revisited places of the same submap and distribute the drift over the loop. If off, only drift of a few
    pixels is corrected (the paper has no loop closure)."""

    def __post_init__(self) -> None:
        _positive(self, "keyframe_min_gap_s", "keyframe_max_gap_s", "keyframe_parallax_deg", "neighbours")
        if self.window < 2:
            raise ValueError(f"window must be at least 2, got {self.window}")
        if self.max_keyframes < self.window + self.window_fixed:
            raise ValueError(f"max_keyframes must be at least window + window_fixed, got {self.max_keyframes}")


@dataclass(frozen=True, slots=True)
class EdgeConfig:
    """Stages 1 and 3: Canny edges and the semi-dense edge map."""

    canny_low: float = 40.0
    """Grey-level gradient (L2 norm, 3x3 Sobel) from which on a pixel continues an edge."""
    canny_high: float = 100.0
    """The same for a pixel that starts an edge."""
    max_pixels: int = 5000
    """Edge pixels kept per keyframe, evenly thinned."""
    max_sigma: float = 0.025
    """Maximum relative depth sigma of an edge point in the map: half a pixel at 525 px over a baseline of 4 % of the
    depth."""
    min_observations: int = 2
    """Keyframes that must agree on a point of the exported map."""
    voxel: float = 0.005
    """Side of a fusion cell relative to the median scene depth."""
    max_points: int = 400_000
    """Maximum number of points; points of a single keyframe are removed first, then half of the oldest."""

    def __post_init__(self) -> None:
        _positive(self, "canny_low", "canny_high", "max_pixels", "max_sigma", "voxel", "max_points")
        if self.canny_high < self.canny_low:
            raise ValueError(f"canny_high must not be below canny_low, got {self.canny_high} < {self.canny_low}")


_FLYING_FORMS: dict[str, tuple[Any, Any]] = {
    "alignment": (True, False),
    "cycle": ("relative", "off"),
    "angle": ("arms", "off"),
    "collinearity": ("relative", "off"),
}
"""Losses of the windows in flight: default form, and the value that disables each."""


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """Stage 4: which losses refine poses, anchors and edge depths, and in which form.

    Each term is off, in the default form, or ``literal``: the paper's equation as printed
    (``docs/theory/README.md``). Edge and corner terms are used in the last refinement, after all edges are measured,
    and in the windows in flight according to ``in_flight``.
    """

    reprojection: str = "robust"
    """``robust``: whitened by octave, Huber kernel; ``literal``: eqs. 15-16, plain squared pixels; ``off``: no
    refinement in flight, and anchors are not refined."""
    alignment: bool = True
    """Distance of projected edge pixels from their partner edge, along its normal; not in the paper."""
    cycle: str = "relative"
    """``relative`` depth, ``literal`` (eqs. 17-23: pixels, unit sigma, no kernel) or ``off``."""
    angle: str = "off"
    """Across views: directions of both ``arms`` of a corner, ``cosine`` of their angle (eqs. 24-25 across views),
    ``literal`` (eqs. 24-25 in one frame: identically zero) or ``off``."""
    collinearity: str = "off"
    """Straight arms (eq. 26): by the depths' own sigma (``relative``), ``literal`` (metres, a sigma of one) or
    ``off``."""
    adaptive: bool = True
    """Whiten edge and corner terms by the robust scales of their residuals (paper: "adaptive weighting")."""
    edges_per_keyframe: int = 400
    """Edge pixels used per keyframe."""
    targets: int = 2
    """Neighbouring keyframes in which each edge pixel is associated."""
    in_flight: str = "few"
    """Windows in flight with edge and corner terms: ``off``; ``few``: if the newest keyframe's image has few strong
    corners (``orb.fast_faint`` was needed) or it has fewer than 100 anchors; or ``always``."""
    in_flight_losses: tuple[str, ...] = ("alignment", "cycle")
    """Subset of ``alignment``, ``cycle``, ``angle`` and ``collinearity`` in flight, each in the form selected above or,
    if that is off, its default."""
    in_flight_edges: int = 300
    """Edge pixels per keyframe in flight."""
    solver: str = "compiled"
    """Residuals by ``compiled`` loops, or by the ``modules`` of `edgeslam_torch.losses`: same values, far slower."""
    telemetry: str = "every"
    """Use the drone's displacements, heights and gravity to constrain the map's scale and level: in ``every``
    refinement, in the ``last`` one, or ``off``."""

    def __post_init__(self) -> None:
        _positive(self, "edges_per_keyframe", "targets", "in_flight_edges")
        for loss in self.in_flight_losses:
            if loss not in _FLYING_FORMS:
                raise ValueError(f"in_flight_losses must be among {', '.join(_FLYING_FORMS)}, got {loss!r}")
        for name, allowed in (
            ("reprojection", ("robust", "literal", "off")),
            ("cycle", ("relative", "literal", "off")),
            ("angle", ("arms", "cosine", "literal", "off")),
            ("collinearity", ("relative", "literal", "off")),
            ("in_flight", ("off", "few", "always")),
            ("solver", ("compiled", "modules")),
            ("telemetry", ("every", "last", "off")),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} must be one of {', '.join(allowed)}, got {getattr(self, name)!r}")

    @property
    def flying(self) -> "WindowConfig | None":
        """The terms of the windows in flight; None without edge and corner terms."""
        if self.in_flight == "off" or not self.in_flight_losses:
            return None
        form: dict[str, Any] = {}
        for loss, (default, none) in _FLYING_FORMS.items():
            chosen = getattr(self, loss)
            form[loss] = none if loss not in self.in_flight_losses else default if chosen == none else chosen
        return replace(self, edges_per_keyframe=self.in_flight_edges, **form)

    @property
    def uses_edges(self) -> bool:
        """Whether any edge term is on."""
        return self.alignment or self.cycle != "off"

    @property
    def uses_corners(self) -> bool:
        """Whether any corner term is on; the literal angle is identically zero and needs no corners."""
        return self.angle in ("arms", "cosine") or self.collinearity != "off"


@dataclass(frozen=True, slots=True)
class MountConfig:
    """Camera mount on the drone."""

    tilt_deg: float = 12.0
    """Downward tilt of the camera against the body's forward axis; a Tello's within two degrees."""
    forward_m: float = 0.03
    """Distance of the camera ahead of the body's centre."""

    def __post_init__(self) -> None:
        if not -90.0 <= self.tilt_deg <= 90.0:
            raise ValueError(f"tilt_deg must be in [-90, 90], got {self.tilt_deg}")


@dataclass(frozen=True, slots=True)
class SlamConfig:
    """All settings of `EdgeSlam`."""

    seed: int = 0
    """Seed of the robust estimators; output is reproducible for the same seed and input."""
    orb: OrbConfig = field(default_factory=OrbConfig)
    depth: DepthConfig = field(default_factory=DepthConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    flow: FlowConfig = field(default_factory=FlowConfig)
    initialisation: InitialisationConfig = field(default_factory=InitialisationConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    edges: EdgeConfig = field(default_factory=EdgeConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    mount: MountConfig = field(default_factory=MountConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)

    def __post_init__(self) -> None:
        _check_numbers(self)
        if self.seed < 0:
            raise ValueError(f"seed must be at least 0, got {self.seed}")
