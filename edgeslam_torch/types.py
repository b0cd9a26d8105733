"""Every record that crosses a stage boundary. Read this first, then ``slam.py``.

Frames of reference: ``w`` world (z up), ``b`` body (x forward, y left, z up), ``c`` camera (x right, y down,
z forward). ``T_w_c`` takes camera coordinates to world coordinates. Metres, radians, seconds; pixel centres at
integers. Arrays are numpy, float64 for poses and float32 for bulk data, unless a field says otherwise.
"""

import math
from dataclasses import dataclass, field, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

DISAGREEMENT = 3.0
"""Difference between two sources of the scale [sigmas] that a status line mentions; exceeded in 0.3 % by chance."""
SILENCE_S = 1.0
"""Age of the newest state message that a status line mentions: ten of a Tello's messages."""

FloatArray = NDArray[np.floating]
IntArray = NDArray[np.integer]


_SHOWN = 4
"""Numbers of an array that `Record` still shows by value."""


class Record:
    """Base of records with arrays, whose representation shows shapes only."""

    __slots__ = ()

    def __repr__(self) -> str:
        shown = ", ".join(f"{f.name}={_short(getattr(self, f.name))}" for f in fields(self))  # type: ignore[arg-type]
        return f"{type(self).__name__}({shown})"


def _short(value: Any) -> str:
    """A field in a few words."""
    if isinstance(value, StrEnum):
        return str(value)
    if isinstance(value, float):
        return f"{value:.16g}"
    if isinstance(value, (list, tuple, dict)) and len(value) > _SHOWN:
        return f"{type(value).__name__} of {len(value)}"
    shape, dtype = getattr(value, "shape", None), getattr(value, "dtype", None)
    if not isinstance(shape, tuple) or dtype is None:
        return repr(value)
    if len(shape) == 1 and shape[0] <= _SHOWN and np.issubdtype(dtype, np.number):
        return f"[{', '.join(f'{x:.4g}' for x in value)}]"
    return f"<{'x'.join(map(str, shape))} {dtype}>"


@dataclass(frozen=True, slots=True, repr=False)
class Frame(Record):
    """One camera image."""

    index: int
    """Position in the source, from 0; a gap is a dropped or unreadable image."""
    stamp_s: float
    """Time of exposure [s]."""
    image: NDArray[np.uint8]
    """``(H, W, 3)`` BGR or ``(H, W)`` grey, as OpenCV reads it, with the lens distortion still in it."""
    path: Path | None = None
    """File it came from, for messages."""
    grey: NDArray[np.uint8] | None = None
    """``(H, W)`` if the reader decodes it directly; None to derive it from ``image``."""

    @property
    def name(self) -> str:
        """Its file or its number, for messages."""
        return str(self.path or f"frame {self.index}")

    @classmethod
    def from_rgb(cls, index: int, stamp_s: float, image: object) -> "Frame":
        """A frame of an RGB or grey image as networks have it: an array or a tensor of any device.

        Args:
            index: Position in the source, from 0.
            stamp_s: Time of exposure [s].
            image: ``(H, W, 3)``, ``(3, H, W)``, ``(H, W)`` or ``(1, H, W)``; uint8, or floating point in [0, 1].

        Raises:
            TypeError: If it is no image of these types.
            ValueError: If it has another shape, or values outside of [0, 1].

        Example:
            >>> Frame.from_rgb(0, 0.0, np.full((3, 4, 6), 0.5, np.float32))
            Frame(index=0, stamp_s=0, image=<4x6x3 uint8>, path=None, grey=None)
        """
        detach = getattr(image, "detach", None)
        pixels: Any = np.asarray(image if detach is None else detach().cpu())
        if pixels.ndim == 3 and pixels.shape[0] in (1, 3) and pixels.shape[2] not in (1, 3):
            pixels = pixels.transpose(1, 2, 0)
        if pixels.ndim == 3 and pixels.shape[2] == 1:
            pixels = pixels[..., 0]
        if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3) or not pixels.size:
            raise ValueError(f"an RGB image is (H, W, 3) or (3, H, W), a grey one (H, W), got {pixels.shape}")
        if np.issubdtype(pixels.dtype, np.floating):
            low, high = float(pixels.min()), float(pixels.max())
            if not (low >= 0.0 and high <= 1.0):  # false for NaN as well
                raise ValueError(f"floating-point images lie in [0, 1], got {low:g} to {high:g}")
            pixels = np.rint(255.0 * pixels.astype(np.float32)).astype(np.uint8)
        if pixels.dtype != np.uint8:
            raise TypeError(f"an image is uint8, or floating point in [0, 1], got {pixels.dtype}")
        return cls(index, stamp_s, np.ascontiguousarray(pixels[..., ::-1] if pixels.ndim == 3 else pixels))


@dataclass(frozen=True, slots=True, repr=False)
class TelemetrySample(Record):
    """One state message of the drone in SI units; a missing field is NaN.

    Velocity is in the frame fixed at power-on, rotated to our world axes (x forward at power-on, y left, z up);
    `drone/sdk_state.py` converts the SDK's north-east-down decimetres.
    """

    stamp_s: float
    """Arrival time [s], on the frames' clock."""
    velocity_m_s: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    """``(3,)`` linear velocity [m/s]."""
    rpy_rad: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    """``(3,)`` roll, pitch, yaw of the body in the power-on world, ``R = Rz(yaw) Ry(pitch) Rx(roll)``."""
    height_m: float = np.nan
    """Height above take-off (SDK ``h``)."""
    tof_m: float = np.nan
    """Range to the floor below (SDK ``tof``)."""
    baro_m: float = np.nan
    """Barometric height (SDK ``baro``)."""
    acceleration_m_s2: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    """``(3,)`` specific force in the body frame."""
    battery: float = np.nan
    """Charge in [0, 1]."""


def check_frame(frame: Frame) -> None:
    """Refuse what is no frame, or whose image is not as OpenCV reads it.

    Raises:
        TypeError: If it is no `Frame`, or its image no array of uint8.
        ValueError: If the image has another shape, or the stamp is not a finite number.
    """
    if not isinstance(frame, Frame):
        raise TypeError(f"a Frame is expected, got {type(frame).__name__}: Frame(index, stamp_s, image)")
    image = frame.image
    remedy = "make it by Frame.from_rgb(index, stamp_s, image), which takes RGB, tensors and floating point in [0, 1]"
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        got = f"{type(image).__name__} {getattr(image, 'dtype', '')} {tuple(getattr(image, 'shape', ()))}"
        raise TypeError(
            f"{frame.name}: an image is a numpy array of uint8, (H, W, 3) BGR or (H, W), got {got}; {remedy}"
        )
    if image.ndim not in (2, 3) or (image.ndim == 3 and image.shape[2] != 3) or not image.size:
        raise ValueError(f"{frame.name}: an image is (H, W, 3) BGR or (H, W), got {image.shape}; {remedy}")
    if not math.isfinite(frame.stamp_s):
        raise ValueError(f"{frame.name}: the stamp must be a finite number of seconds, got {frame.stamp_s}")


@dataclass(frozen=True, slots=True, repr=False)
class FrameFeatures(Record):
    """ORB keypoints of one frame (stage 1)."""

    uv: FloatArray
    """``(N, 2)`` undistorted pixels, float32."""
    octave: IntArray
    """``(N,)`` pyramid level, int32."""
    angle_rad: FloatArray
    """``(N,)`` orientation, float32."""
    descriptors: NDArray[np.uint8]
    """``(N, 32)`` ORB bits."""
    corner: NDArray[np.bool_] | None = None
    """``(N,)`` whether they lie on corners, and not on straight edges, along which they slide; None: all."""
    faint: bool = False
    """Whether the image has too few clear corners, so that fainter ones are among these."""

    def on_corners(self, keypoint: IntArray) -> NDArray[np.bool_]:
        """Which of some keypoints ``(M,)`` lie on corners."""
        return np.ones(len(keypoint), bool) if self.corner is None else np.asarray(self.corner[keypoint])


@dataclass(frozen=True, slots=True, repr=False)
class Edges(Record):
    """Canny edge pixels of one keyframe (stage 1)."""

    uv: FloatArray
    """``(E, 2)`` undistorted pixels, float32."""
    normal: FloatArray
    """``(E, 2)`` unit image gradient, across the edge, float32."""
    colour: NDArray[np.uint8]
    """``(E, 3)`` RGB."""


@dataclass(frozen=True, slots=True, repr=False)
class DepthMap(Record):
    """Depth network output for one image (stage 1)."""

    depth_m: FloatArray
    """``(H, W)`` z-depth [m], float32, in the pixels of the *undistorted* image; NaN or <= 0 where unknown."""
    sigma_log: FloatArray
    """``(H, W)`` standard deviation of log depth, float32."""
    is_relative: bool = False
    """Whether the inverse of ``depth_m`` is right up to an unknown scale and shift only; it is not in metres then."""


@dataclass(frozen=True, slots=True, repr=False)
class RelativePose(Record):
    """Two-view motion from the essential matrix (stage 2), paper eqs. (2)-(5)."""

    T_j_i: FloatArray
    """``(4, 4)``, takes coordinates of view i to view j; translation of unit length."""
    inliers: NDArray[np.bool_]
    """``(M,)`` inlier matches; none if there is no motion."""


class Units(StrEnum):
    """Units of a trajectory."""

    METRES = "metres"
    ARBITRARY = "arbitrary"


@dataclass(frozen=True, slots=True)
class ScaleEstimate:
    """Metres per map unit with its uncertainty."""

    value: float = 1.0
    sigma: float = np.inf
    """Standard deviation of ``value``; infinite while unknown."""
    source: str = "none"
    """Sources: ``none``, ``depth``, ``telemetry``, ``height``, ``imu``, or several, joined by ``+``."""

    @property
    def units(self) -> Units:
        """Metres only when the scale is known."""
        return Units.METRES if np.isfinite(self.sigma) else Units.ARBITRARY


class FrameStatus(StrEnum):
    """How a frame got its pose."""

    STARTING = "starting"
    """Begins a submap, or is tracked on its predicted depths: no triangulated anchor can contradict them yet."""
    INITIALISED = "initialised"
    """The frame with enough parallax to create the map."""
    TRACKED = "tracked"
    RELOCALISED = "relocalised"
    PREDICTED = "predicted"
    LOST = "lost"

    @property
    def supported(self) -> bool:
        """Whether the pose is tracked on a map that agrees with the images."""
        return self in (FrameStatus.INITIALISED, FrameStatus.TRACKED, FrameStatus.RELOCALISED)


@dataclass(frozen=True, slots=True)
class Piece:
    """Frames tracked on one connected map; the transform between pieces is unknown."""

    number: int
    """From 0, in the order of creation."""
    frames: int
    supported: int
    """Frames whose final pose is supported by the map."""
    first_s: float
    last_s: float
    """Stamps of its first and its last frame."""
    begun: str
    """Where its first pose and scale come from, in words."""


@dataclass(frozen=True, slots=True, repr=False)
class Support(Record):
    """What supports each frame's final pose."""

    piece: IntArray
    """``(F,)`` piece that the frame belongs to."""
    supported: NDArray[np.bool_]
    """``(F,)`` whether the map supports its pose."""

    def largest(self) -> int:
        """Number of the piece with most supported frames; the oldest of equals."""
        numbers, frames = np.unique(self.piece[self.supported], return_counts=True)
        return int(numbers[frames.argmax()]) if len(numbers) else 0

    def others(self) -> list[int]:
        """Numbers of the other pieces with supported frames."""
        return [int(n) for n in np.unique(self.piece[self.supported]) if n != self.largest()]

    def whole(self) -> NDArray[np.bool_]:
        """``(F,)`` frames of the largest piece, and those of no piece: predictions from it."""
        return ~np.isin(self.piece, self.others())


@dataclass(frozen=True, slots=True)
class Health:
    """Reliability of a pose and of its metric scale."""

    stamp_s: float
    """Stamp of the frame."""
    state: str
    """State of the machine, see `edgeslam_torch.states.machine.State`: ``starting``, ``tracking``, ``edges only``,
    ``lost``."""
    metric: bool
    """As in `SlamOutput`."""
    scale: ScaleEstimate
    """All sources together."""
    sources: tuple[ScaleEstimate, ...] = ()
    """Each source alone: ``telemetry`` (velocities), ``height``, ``depth``; those not used as well."""
    disagreement: float = 0.0
    """Largest distance between two of them, in standard deviations of their difference."""
    telemetry_age_s: float = np.inf
    """Since the newest state message; infinite without telemetry."""
    delay_s: float = np.nan
    """Of the video behind telemetry; NaN while it is not known."""
    delay_sigma_s: float = np.inf
    battery: float = np.nan
    """Charge in [0, 1]; NaN while it is not known."""
    filtering: bool = False
    """Whether the Kalman filter predicts the pose: `EdgeSlam.pose_now` makes up for the delay."""
    doubts: tuple[str, ...] = ()
    """Warnings about sources that are not used."""
    submap_sigma: float = 0.0
    """Standard deviation per axis of the newest pose relative to the flight's first submap [published unit], by the
    drone's sensors that relate the two; 0 in the first one, infinite if unrelated."""
    drift_sigma: float = 0.0
    """Standard deviation per axis of the map's drift since the first frame: it grows with the path, and shrinks at a
    revisit. The uncertainty of the scale (`scale`) comes on top."""

    @property
    def home_sigma(self) -> float:
        """Standard deviation per axis of the newest pose, seen from where the flight began [published unit]."""
        return float(np.hypot(self.submap_sigma, self.drift_sigma))

    def __str__(self) -> str:
        """Status line: metric scale, disagreement, telemetry and battery."""
        relative = self.scale.sigma / self.scale.value
        words = [f"metres to {100.0 * relative:.0f} %" if self.metric else "no metres"]
        if self.disagreement > DISAGREEMENT:
            words.append(f"sources differ by {self.disagreement:.0f} sigmas")
        if np.isinf(self.submap_sigma):
            words.append("submap unrelated to where the flight began")
        elif self.submap_sigma > 0:
            words.append(f"position sigma {self.home_sigma:.2g} {'m' if self.metric else 'units'} from the start")
        if SILENCE_S < self.telemetry_age_s < np.inf:
            words.append(f"no telemetry for {self.telemetry_age_s:.1f} s")
        if np.isfinite(self.battery):
            words.append(f"battery {100.0 * self.battery:.0f} %")
        return ", ".join(words)


@dataclass(frozen=True, slots=True, repr=False)
class SlamOutput(Record):
    """Result of `EdgeSlam.step` for one frame."""

    index: int
    stamp_s: float
    T_w_c: FloatArray
    """``(4, 4)`` camera to world; always finite; ``status`` says how reliable it is."""
    status: FrameStatus
    reason: str
    """Reason for the status, in words; empty for ordinary tracking."""
    matches: int
    inliers: int
    parallax_rad: float
    """Median ray angle between this frame and its reference keyframe."""
    keyframe: bool
    piece: int
    """Piece of map that the pose belongs to; poses of different pieces are unrelated."""
    scale: ScaleEstimate
    """Metres per map unit, current estimate; published units change only by revisions."""
    metric: bool
    """Whether the unit of ``T_w_c`` is a metre within the uncertainty of the scale."""
    revision: int
    """Changes of the unit of ``T_w_c`` so far; after a change, read earlier poses and points again."""
    stage_ms: dict[str, float]
    """Time of each stage in this step [ms]."""
    health: Health | None = None
    """Reliability of the pose and its metres; None only in outputs made by hand."""
    unit: float = 1.0
    """Length of a map unit in the unit of ``T_w_c``; a revision changes it."""


@dataclass(frozen=True, slots=True, repr=False)
class PoseNow(Record):
    """Where the camera is at a moment, with the delay of the video made up for.

    Frame: the world of `SlamOutput.T_w_c`. Unit: metres where ``metric``, else the unit of the published trajectory.
    """

    stamp_s: float
    """The moment, on the clock on which frames and telemetry arrive."""
    T_w_c: FloatArray
    """``(4, 4)`` camera to world."""
    velocity_w: FloatArray
    """``(3,)`` of the drone's body, or of the camera without a drone [unit/s]."""
    covariance: FloatArray
    """``(9, 9)`` of position, rotation vector [rad] and velocity in world axes, with respect to the map: what the map
    itself is off is not in it."""
    source: str
    """``filter``: Kalman filter, the video's delay is made up for. ``visual``: constant velocity from the last frames,
    as if the video were not late. ``visual+imu``: the same, with the rotation of a gyroscope."""
    seen_s: float
    """Stamp of the last frame whose place in the map is known."""
    metric: bool
    """Whether the unit is a metre to within the scale's uncertainty."""
    revision: int
    """As in `SlamOutput`."""


@dataclass(frozen=True, slots=True, repr=False)
class PointCloud(Record):
    """Points with colour and uncertainty, in the trajectory's world frame."""

    p_w: FloatArray
    """``(P, 3)`` float32 [m, or map units while the scale is unknown]."""
    colour: NDArray[np.uint8]
    """``(P, 3)`` RGB."""
    sigma_m: FloatArray
    """``(P,)`` standard deviation along the viewing ray, float32."""
    observations: IntArray
    """``(P,)`` keyframes that observed the point, int32."""


@dataclass(frozen=True, slots=True, repr=False)
class Observations(Record):
    """Anchors that keyframes observed."""

    stamps_s: FloatArray
    """``(K,)`` stamps of the keyframes [s]."""
    keyframe: IntArray
    """``(O,)`` index into ``stamps_s``."""
    anchor: IntArray
    """``(O,)`` row of the cloud of anchors."""
    uv: FloatArray
    """``(O, 2)`` undistorted pixels."""
