"""A camera that reads its rows one after the other, as phones do, while it moves."""

from dataclasses import replace

import numpy as np
import pytest

from edgeslam_torch.config import SlamConfig
from edgeslam_torch.eval.metrics.align import umeyama
from edgeslam_torch.geometry import se3
from edgeslam_torch.slam import EdgeSlam
from edgeslam_torch.synthetic.flights.courses import COURSES, flown, simulated_camera
from edgeslam_torch.synthetic.house.render import render
from edgeslam_torch.types import Frame

BANDS = 8
"""Rows that are read together: 45 of 360 px."""


def rolled(world, camera, flight, k, readout_s):
    """Image ``k``: the middle row is read at its stamp, the first half a readout earlier."""
    T_w_c, twist = flight.T_w_c[k], flight.twist_c(k)
    height = camera.height // BANDS
    parts = []
    for band in range(BANDS):
        dt = readout_s * ((band + 0.5) / BANDS - 0.5)
        rows = replace(camera, height=height, cy=camera.cy - band * height)
        parts.append(render(world, rows, T_w_c @ se3.exp(dt * twist), antialias=False).image)
    return np.concatenate(parts)


@pytest.mark.slow
def test_the_readout_of_a_phone_costs_little_on_a_slow_way():
    """20 ms at .4 m/s and 35 degrees a second: the row that is read last is 4 px late."""
    camera, slam = simulated_camera(480, 360), EdgeSlam(simulated_camera(480, 360), SlamConfig())
    world, flight, _ = flown(COURSES["room"], 0, 6.0)
    for k in range(len(flight.stamps_s)):
        slam.step(Frame(k, float(flight.stamps_s[k]), rolled(world, camera, flight, k, 0.02)))
    slam.finish()
    seen, true = slam.trajectory()[1][:, :3, 3], flight.T_w_c[:, :3, 3]
    support, error = slam.support(), umeyama(seen, true, "sim3").points(seen) - true
    slam.close()
    assert support.supported.all() and not support.others()
    path_m = float(np.linalg.norm(np.diff(true, axis=0), axis=1).sum())
    assert float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) < 0.006 * path_m
