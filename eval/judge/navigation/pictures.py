"""Top views of judged flights: world, path flown, start and goal."""

import cv2
import numpy as np

from edgeslam_torch.eval.judge.navigation.flown import Flown
from edgeslam_torch.eval.judge.navigation.oracle import true_layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.synthetic.sites.build import named_site
from edgeslam_torch.types import FloatArray

_PX = 6
"""A cell's side in the picture."""
_WALL, _AIR, _WAY, _START, _GOAL = (60, 60, 60), (235, 235, 235), (200, 90, 20), (0, 150, 0), (0, 0, 220)


def top_view(flown: Flown) -> np.ndarray:
    """``(H, W, 3)`` BGR, x to the right, y up."""
    site = named_site(flown.case.world, flown.case.seed)
    layer = true_layer(site, NavLimits())
    image = np.full((*layer.free.shape, 3), _AIR, np.uint8)
    image[layer.solid] = _WALL
    image = np.ascontiguousarray(image[:, ::-1].transpose(1, 0, 2))
    image = np.asarray(cv2.resize(image, None, fx=_PX, fy=_PX, interpolation=cv2.INTER_NEAREST))
    height = layer.free.shape[1]

    def pixel(p: FloatArray) -> tuple[int, int]:
        x, y = (p[:2] - layer.corner_w) / layer.cell_m * _PX
        return round(x), round(height * _PX - y)

    track = np.array(flown.track_w).reshape(-1, 3)
    for a, b in zip(track[:-1], track[1:], strict=True):
        cv2.line(image, pixel(a), pixel(b), _WAY, 2, cv2.LINE_AA)
    cv2.circle(image, pixel(np.zeros(2)), 6, _START, -1, cv2.LINE_AA)
    cv2.circle(image, pixel(site.goal_w), 6, _GOAL, -1, cv2.LINE_AA)
    words = f"{flown.case.world} {flown.case.seed} {flown.case.fault}: {flown.ended}, {flown.contacts} contacts"
    return captioned(image, words)


def captioned(image: np.ndarray, words: str) -> np.ndarray:
    """The image with a white caption on a dark strip at its top, in place."""
    cv2.rectangle(image, (0, 0), (image.shape[1], 21), (30, 30, 30), -1)
    cv2.putText(image, words, (6, 15), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (255, 255, 255), 1, cv2.LINE_AA)
    return image
