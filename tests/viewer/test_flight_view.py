"""A flight in rerun: what is shown is what the pilot knows."""

from importlib.util import find_spec

import numpy as np
import pytest

from edgeslam_torch.flying.flight_controller import FlightController
from edgeslam_torch.navigation.drone_state import DroneState
from edgeslam_torch.navigation.layer import Layer
from edgeslam_torch.navigation.limits import NavLimits
from edgeslam_torch.navigation.openings.exit_tracker import Exit
from edgeslam_torch.viewer.flight_view import FlightView

pytestmark = pytest.mark.skipif(find_spec("rerun") is None, reason="the viewer extra is not installed")


class Stream:
    """Remembers what is logged."""

    def __init__(self):
        self.shown = {}

    def log(self, entity, what, static=False):
        self.shown.setdefault(entity, []).append(what)

    def set_time(self, *_, **__):
        pass


@pytest.fixture
def view(tmp_path):
    view = FlightView("test", tmp_path / "flight.rrd")
    view.close()
    assert (tmp_path / "flight.rrd").stat().st_size > 100
    view._stream = Stream()
    return view


def state(stamp_s, x=0.0, **fields):
    return DroneState(stamp_s, np.array([x, 0.0, 1.1]), 0.0, np.array([0.3, 0.0, 0.0]), **fields)


def test_space_way_exits_and_reasons(view):
    flight_controller = FlightController(NavLimits(), [view])
    free = np.zeros((4, 4), bool)
    free[1, 2] = True
    flight_controller.pilot.layer = Layer(free, ~free, np.zeros(2), 0.1)
    flight_controller.pilot.exits.exits = (
        Exit(np.array([2.0, 0.5, 1.1]), np.array([1.0, 0.0, 0.0]), 0.9, 0.05, 0.1, 3),
    )
    flight_controller.order(state(0.0))
    shown = view._stream.shown
    (cells,) = shown["world/free"]
    assert np.array(cells.centers.as_arrow_array().to_pylist()) == pytest.approx(
        np.array([[0.15, 0.25, 1.1]]), abs=1e-6
    )
    assert len(shown["world/solid"][0].centers) == 15
    (line,) = shown["world/exits"][0].strips.as_arrow_array().to_pylist()
    assert np.array(line) == pytest.approx(np.array([[2.0, 0.05, 1.1], [2.0, 0.95, 1.1]]), abs=1e-6)
    assert len(shown["reasons"]) == 1
    flight_controller.order(state(0.1, 0.03))
    assert len(shown["world/free"]) == 1, "the space is shown twice a second"
    assert len(shown["world/drone"]) == 2 and len(shown["reasons"]) == 1


def test_a_revised_unit_begins_the_way_anew(view):
    flight_controller = FlightController(NavLimits(), [view])
    for k in range(4):
        flight_controller.order(state(0.1 * k, 0.03 * k))
    flight_controller.order(state(1.0, 0.5, revision=1))
    last = view._stream.shown["world/flown"][-1]
    assert len(last.strips.as_arrow_array().to_pylist()[0]) == 1
