"""Arithmetic as text, with draws from a seed."""

import numpy as np
import pytest

from edgeslam_torch.errors import ConfigError
from edgeslam_torch.synthetic.house.values import Values


def drawn(rng, **values):
    found = Values(rng, {})
    found.define(values)
    return found


def test_values_are_drawn_in_order_and_later_ones_use_them():
    rng = np.random.default_rng(4)
    wide, coin = rng.uniform(2, 3), rng.random()
    value = drawn(np.random.default_rng(4), wide="uniform(2, 3)", half="wide / 2", side="either(-1, 1)")
    assert value("half * side") == pytest.approx(wide / 2 * (-1 if coin < 0.5 else 1))
    assert drawn(rng, half=4.0)(("half", 3, "steps(0, half, 1.5)")) == [4.0, 3, [0.0, 1.5, 3.0]]
    two = drawn(rng, two="sample(2, 5, 6, 7)")
    assert sum(two(f"1 if {k} in two else 0") for k in (5, 6, 7)) == 2


@pytest.mark.parametrize(
    "text",
    ["__import__('os')", "(1).real", "'a' * 3", "[0 for x in steps(0, 1, 1)]", "lambda: 1", "f'{pi}'"],
)
def test_what_is_more_than_arithmetic_is_refused(text):
    with pytest.raises(ConfigError, match="is not arithmetic"):
        Values(np.random.default_rng(0), {})(text)
