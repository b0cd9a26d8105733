"""A furnished room and a flight through it."""

import numpy as np
import pytest

from edgeslam_torch.synthetic.flights.flight import fly
from edgeslam_torch.synthetic.flights.paths import inspect
from edgeslam_torch.synthetic.sites.build import place


@pytest.fixture(scope="session")
def home():
    return place("furnished_room", np.random.default_rng(3))


@pytest.fixture(scope="session")
def flight(home):
    return fly(np.random.default_rng(3), home, 900, inspect)
