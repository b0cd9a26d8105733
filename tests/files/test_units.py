import math

import pytest

from edgeslam_torch.files.units import si_per_unit


@pytest.mark.parametrize(
    ("quantity", "unit", "si"),
    [("time", "\N{MICRO SIGN}s", 1e-6), ("time", "\N{GREEK SMALL LETTER MU}s", 1e-6), ("length", "Feet", 0.3048),
     ("speed", "cm/s", 0.01), ("speed", "mm_s", 1e-3), ("speed", "knots", 0.514444), ("angle", "deg.", math.pi / 180),
     ("acceleration", "g", 9.80665), ("share", "%", 0.01)],
)  # fmt: skip
def test_units_in_si(quantity, unit, si):
    assert si_per_unit(quantity, unit) == pytest.approx(si, rel=1e-5)


@pytest.mark.parametrize("unit", ["", "furlong", "s", "m/s"])
def test_other_words_are_no_length(unit):
    assert math.isnan(si_per_unit("length", unit))
