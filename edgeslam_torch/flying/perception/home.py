"""The drone's world frame: origin on the floor below the first frame, x along the heading there, in metres."""

import math
from dataclasses import dataclass

import numpy as np

from edgeslam_torch.estimation.output_frame import CONTRADICTION, SURE
from edgeslam_torch.geometry import se3
from edgeslam_torch.navigation.supervisor import SCALE_SIGMA
from edgeslam_torch.types import FloatArray, SlamOutput

GROUND_M = 0.1
"""Height of the body when the drone stands on the floor."""
_OFF = 0.01
"""Minimum scale error that is corrected: 0.1 m at 10 m. Every correction makes the planner rebuild its grid."""


@dataclass(frozen=True, slots=True)
class Home:
    """Similarity from the SLAM's output world ``w`` to the drone's world: ``scale R p + shift_m``."""

    R: FloatArray
    """``(3, 3)``."""
    scale: float
    """Metres per output unit."""
    shift_m: FloatArray
    """``(3,)``."""

    @staticmethod
    def of(T_w_first: FloatArray, scale: float, T_b_c: FloatArray) -> "Home":
        """The world in which the body of the first frame stands at the origin.

        Args:
            T_w_first: ``T_w_c`` of the SLAM's first frame ``(4, 4)``, in output units.
            scale: Metres per output unit.
            T_b_c: Camera on the body ``(4, 4)`` [m].
        """
        T_w_b = T_w_first @ se3.inverse(T_b_c)
        yaw = math.atan2(T_w_b[1, 0], T_w_b[0, 0])
        c, s = math.cos(yaw), math.sin(yaw)
        R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        body_m = scale * (R @ T_w_first[:3, 3]) + R @ (T_w_b[:3, 3] - T_w_first[:3, 3])
        return Home(R, scale, np.array([0.0, 0.0, GROUND_M]) - body_m)

    def poses(self, T_w_c: FloatArray) -> FloatArray:
        """``T_w_c`` ``(..., 4, 4)`` in the drone's world [m]."""
        out = np.array(T_w_c, dtype=np.float64)
        out[..., :3, :3] = self.R @ T_w_c[..., :3, :3]
        out[..., :3, 3] = self.scale * (T_w_c[..., :3, 3] @ self.R.T) + self.shift_m
        return out


def metres_per_unit(known: float, output: SlamOutput, late: bool) -> float:
    """Metres per map unit to be used from now on.

    The SLAM keeps its output unit until it is surely wrong, so as not to bend the trajectory; navigation needs the best
    estimate. An uncertain estimate replaces the current one only if they contradict each other.

    Args:
        known: Current value; not finite if the scale is unknown.
        output: SLAM output of the newest frame.
        late: Whether the last correction of the map was long ago; only an error that matters is corrected sooner.
    """
    if not output.metric or not math.isfinite(output.scale.sigma):
        return known
    best, sigma_log = output.scale.value, output.scale.sigma / output.scale.value
    least = _OFF if sigma_log < SURE else max(_OFF, CONTRADICTION * sigma_log)
    least = least if late else max(least, SCALE_SIGMA)
    return known if math.isfinite(known) and abs(math.log(best / known)) < least else best
