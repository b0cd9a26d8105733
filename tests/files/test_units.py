import math

import pytest

from edgeslam_torch.eval.inputs.columns import columns_by_name
from edgeslam_torch.files.units import UNITS, si_per_unit
from edgeslam_torch.readers.logs.columns import column_of


@pytest.mark.parametrize(
    ("quantity", "unit", "si"),
    [
        ("time", "\N{MICRO SIGN}s", 1e-6),
        ("time", "\N{GREEK SMALL LETTER MU}s", 1e-6),
        ("length", "Feet", 0.3048),
        ("length", "in", 0.0254),
        ("speed", "cm/s", 0.01),
        ("speed", "mm_s", 1e-3),
        ("speed", "knots", 0.514444),
        ("angle", "deg.", math.pi / 180),
        ("acceleration", "g", 9.80665),
        ("share", "%", 0.01),
    ],
)
def test_units_in_si(quantity, unit, si):
    assert si_per_unit(quantity, unit) == pytest.approx(si, rel=1e-5)


@pytest.mark.parametrize("unit", ["", "furlong", "s", "m/s"])
def test_other_words_are_no_length(unit):
    assert math.isnan(si_per_unit("length", unit))


@pytest.mark.parametrize("unit", UNITS["length"])
def test_poses_and_telemetry_know_the_same_lengths(unit):
    names = f"time [s],x [{unit}],y [{unit}],z [{unit}]".split(",")
    assert columns_by_name(names).metres == column_of(f"baro [{unit}]")[1] == UNITS["length"][unit]


@pytest.mark.parametrize("unit", UNITS["time"])
def test_poses_know_all_units_of_time(unit):
    assert columns_by_name(f"t ({unit}),x,y,z".split(",")).time[0][1] == UNITS["time"][unit]
