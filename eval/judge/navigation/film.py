"""Film strips of judged flights: what the camera saw, over the whole flight and before the narrowest moment."""

import numpy as np

from edgeslam_torch.eval.judge.navigation.flown import Flown
from edgeslam_torch.eval.judge.navigation.pictures import captioned
from edgeslam_torch.geometry.camera import PRESETS
from edgeslam_torch.geometry.mount import camera_on_body
from edgeslam_torch.geometry.rotations import matrix_from_rpy
from edgeslam_torch.synthetic.house.render import picture
from edgeslam_torch.synthetic.sites.build import named_site
from edgeslam_torch.types import FloatArray

_SIZE = (320, 240)
_A_ROW = 4
_BEFORE_S = (2.0, 1.0, 0.5, 0.0)
"""Times before the least clearance: the second row."""


def film_strip(flown: Flown) -> np.ndarray | None:
    """``(H, W, 3)`` BGR; None for a flight that ended before it flew, or whose record is older than film strips."""
    if not flown.attitude or len(flown.attitude) != len(flown.track_w):
        return None
    site = named_site(flown.case.world, flown.case.seed)
    camera, T_b_c = PRESETS["tello"].scaled(*_SIZE), camera_on_body()
    tiles = []
    for k in moments(flown):
        clock_s, roll, pitch, yaw, clearance_m = flown.attitude[k]
        T_w_b = np.eye(4)
        T_w_b[:3, :3] = matrix_from_rpy(np.array([roll, pitch, yaw]))
        T_w_b[:3, 3] = flown.track_w[k]
        tile = picture(site.painted(clock_s), camera, site.T_site_w @ T_w_b @ T_b_c)
        tiles.append(captioned(tile, f"{clock_s:.1f} s, {clearance_m:.2f} m"))
    return np.vstack([np.hstack(tiles[:_A_ROW]), np.hstack(tiles[_A_ROW:])])


def moments(flown: Flown) -> list[int]:
    """Eight ticks: four spread over the flight, then four that end with the least clearance."""
    attitude: FloatArray = np.array(flown.attitude)
    spread = np.linspace(0, len(attitude) - 1, _A_ROW).round().astype(int)
    narrowest_s = attitude[int(np.argmin(attitude[:, 4])), 0]
    before = [int(np.argmin(np.abs(attitude[:, 0] - (narrowest_s - s)))) for s in _BEFORE_S]
    return [*spread.tolist(), *before]
