"""Worlds that are flown through from room to room."""

import numpy as np
import pytest

from edgeslam_torch.synthetic.flights.flight import FlightPlan, fly_around
from edgeslam_torch.synthetic.house.rooms import BUILDING_M, building


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_the_line_through_the_building_is_free_and_leads_into_all_ten_rooms(seed):
    rng = np.random.default_rng(seed)
    world = building(rng)
    flight = fly_around(rng, world, 840, rate_hz=15.0, plan=FlightPlan(speed_m_s=0.8), sides_m=BUILDING_M)
    p = flight.T_w_b[:, :3, 3]
    assert world.clearance(p).min() > 0.3
    rooms = {(int(column), bool(row > 0)) for column, row in zip(np.floor(p[:, 0] / 4.0 + 2.5), p[:, 1], strict=True)}
    assert rooms == {(column, row) for column in range(5) for row in (False, True)}
