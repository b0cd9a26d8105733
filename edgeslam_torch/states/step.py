"""Result of a state for one frame."""

from dataclasses import dataclass

from edgeslam_torch.map.keyframe import Keyframe
from edgeslam_torch.states.machine import Event
from edgeslam_torch.tracking.tracker import Track, View
from edgeslam_torch.types import FloatArray, FrameStatus


@dataclass(frozen=True, slots=True)
class Step:
    """Result for one frame."""

    event: Event
    keyframe: Keyframe
    """Reference keyframe of the pose."""
    status: FrameStatus
    reason: str = ""
    """Reason for the status."""
    track: Track | None = None
    parallax_rad: float = 0.0
    is_keyframe: bool = False
    T_c_before: FloatArray | None = None
    """``(4, 4)`` as tracked before mapping, relative to the reference keyframe of the previous frame."""


@dataclass(frozen=True, slots=True)
class Located:
    """A frame localised in the map."""

    track: Track
    reference: Keyframe
    parallax_rad: float
    """Median ray angle to the reference."""
    due: bool
    """Whether it should become a keyframe."""
    uv: FloatArray
    """``(M, 2)`` undistorted pixels of the track's inliers."""
    inv_sigma: FloatArray
    """``(M,)`` their inverse standard deviations [1/px]."""
    view: View | None = None
    """Its features, if it was matched; without them it cannot become a keyframe."""
    relocalised: bool = False
    edges: int = 0
    """Number of edge points used for the pose."""
    contradicted: bool = False
    """Whether the drone's sensors contradict the pose, and matching confirmed it all the same."""
