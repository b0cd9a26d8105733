"""A flight past panels at many depths, as its last frame leaves the map: nothing is refined after it."""

import pickle
from functools import lru_cache

import numpy as np
from pickled import pickled
from rendered import CAMERA, film, sideways, stairs_world

from edgeslam_torch.config import DepthConfig, SlamConfig
from edgeslam_torch.map.slam_map import SlamMap
from edgeslam_torch.map.trajectory import TrajectoryLog
from edgeslam_torch.mapping.edges.edge_map import EdgeMap
from edgeslam_torch.slam import EdgeSlam


@lru_cache(maxsize=1)
def _flown() -> tuple[bytes, np.ndarray]:
    filmed = film(stairs_world(), CAMERA, sideways(30, 0.03, turn_rad=0.004))
    slam = EdgeSlam(CAMERA, SlamConfig(depth=DepthConfig(weights="none")))
    for frame in filmed.frames:
        slam.step(frame)
    return pickled((slam.map, slam.edges, slam.log)), filmed.T_w_c


def flown() -> tuple[SlamMap, EdgeMap, TrajectoryLog]:
    """Map, edges and trajectory that a test may change."""
    slam_map, edges, log = pickle.loads(_flown()[0])
    edges.map = slam_map
    return slam_map, edges, log


def true_poses() -> np.ndarray:
    """``(30, 4, 4)`` camera to world."""
    return _flown()[1]
