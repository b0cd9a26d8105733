"""Two sets of runs: what counts as a difference."""

import pytest

from edgeslam_torch.eval.experiment.figures import Figure, compared

ATE = Figure("ate", "ATE", floor=0.03, one_seed=0.10)
SHARE = Figure("share", "share", floor=0.01, relative=False, lower_is_better=False)


def runs(*ates, **figures):
    return [{"figures": {"ate": ate, **figures}} for ate in ates]


@pytest.mark.parametrize(
    ("before", "after", "verdict"),
    [
        ((0.0100, 0.0101, 0.0102), (0.0130, 0.0131, 0.0132), "worse"),
        ((0.0130, 0.0131, 0.0132), (0.0100, 0.0101, 0.0102), "better"),
        ((1.0, 1.0), (1.02, 1.02), "same"),  # below the floor
        ((1.0, 1.0), (1.04, 1.04), "worse"),
        ((1.0,), (1.08,), "same"),  # the floor of a single run
        ((0.5, 1.0, 1.5), (1.2, 1.7, 2.2), "same"),  # 2 sqrt(2 * 0.25 / 3) = 0.82
        ((0.9, 1.0, 1.1), (1.2, 1.3, 1.4), "worse"),
    ],
)
def test_difference_of_medians_is_judged_by_scatter_and_floor(before, after, verdict):
    assert ATE.change(runs(*before), runs(*after)) == verdict


def test_shares_are_better_when_they_grow_and_what_is_gone_is_worse():
    before, after = runs(1.0, share=0.8), runs(None, share=0.9)
    assert (ATE.change(before, after), SHARE.change(before, after)) == ("worse", "better")
    assert ATE.change(after, before) == ""


def test_only_other_conditions_are_told_to_beware_of():
    before = {"machine": {"cpu": "a", "cores": 2}, "seeds": [0], "mode": "fast", "overrides": {"x": 1}}
    after = {"machine": {"cpu": "b", "cores": 2}, "seeds": [0, 1], "mode": "fast", "overrides": None}
    rows = {"rows": []}
    assert compared(before | rows, after | rows, "rows", "cell", [ATE]).splitlines()[1:4] == [
        "beware: cpu was a, then b",
        "beware: seeds was [0], then [0, 1]",
        "beware: overrides was {'x': 1}, then None",
    ]
