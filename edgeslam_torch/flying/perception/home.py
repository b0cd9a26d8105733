"""The drone's own world: origin on the floor below its first picture, x along its heading there, in metres."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.fusion.output_frame import CONTRADICTION, SURE
from edgeslam_torch.geometry import se3
from edgeslam_torch.types import FloatArray, SlamOutput

GROUND_M = 0.1
"""Height of the body when the drone stands on the floor."""
_OFF = 0.01
"""Error of a metre that is put right: 0.1 m at 10 m. Every time costs a pilot as much as all its views together."""


@dataclass(frozen=True, slots=True)
class Place:
    """Where a body is in the drone's own world, and whereto it is turned."""

    position_m: FloatArray
    """``(3,)``"""
    yaw_rad: float


TAKE_OFF = Place(np.array([0.0, 0.0, GROUND_M]), 0.0)


@dataclass(frozen=True, slots=True)
class Home:
    """Similarity from the SLAM's published world ``w`` to the drone's own: ``scale R p + shift_m``."""

    R: FloatArray
    """``(3, 3)``."""
    scale: float
    """Metres per published unit."""
    shift_m: FloatArray
    """``(3,)``."""

    @staticmethod
    def of(T_w_first: FloatArray, scale: float, T_b_c: FloatArray, began: Place = TAKE_OFF) -> "Home":
        """The world that begins below the body of the picture at the take-off.

        Args:
            T_w_first: ``T_w_c`` of the SLAM's first picture ``(4, 4)``, in published units.
            scale: Metres per published unit.
            T_b_c: Camera on the body ``(4, 4)`` [m].
            began: Where its body was in this world.
        """
        T_w_b = T_w_first @ se3.inverse(T_b_c)
        yaw = math.atan2(T_w_b[1, 0], T_w_b[0, 0]) - began.yaw_rad
        c, s = math.cos(yaw), math.sin(yaw)
        R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        body_m = scale * (R @ T_w_first[:3, 3]) + R @ (T_w_b[:3, 3] - T_w_first[:3, 3])
        return Home(R, scale, began.position_m - body_m)

    def poses(self, T_w_c: FloatArray) -> FloatArray:
        """``T_w_c`` ``(..., 4, 4)`` in the drone's own world [m]."""
        out = np.array(T_w_c, dtype=np.float64)
        out[..., :3, :3] = self.R @ T_w_c[..., :3, :3]
        out[..., :3, 3] = self.scale * (T_w_c[..., :3, 3] @ self.R.T) + self.shift_m
        return out


def metres_per_unit(known: float, output: SlamOutput, may_move: bool) -> float:
    """Metres per map unit that a flight goes by from now on.

    The published unit stays what it is until it is surely wrong, so that a trajectory is not bent; a goal in metres is
    better reached by the best estimate. One that is not sure moves what is known only if it leaves no room for it.

    Args:
        known: What it went by so far; not finite if nothing told metres yet.
        output: Of the newest picture.
        may_move: Whether all that is known may be moved for it.
    """
    if not may_move or not output.metric or not math.isfinite(output.scale.sigma):
        return known
    best, sigma_log = output.scale.value, output.scale.sigma / output.scale.value
    least = _OFF if sigma_log < SURE else max(_OFF, CONTRADICTION * sigma_log)
    return known if math.isfinite(known) and abs(math.log(best / known)) < least else best
